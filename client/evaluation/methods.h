// The ways of finding candidates that an evaluation compares.
#ifndef REVISIT_CLIENT_EVALUATION_METHODS_H_
#define REVISIT_CLIENT_EVALUATION_METHODS_H_

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

#include "client/evaluation/evaluate_options.h"
#include "client/evaluation/evaluation.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

// A way of finding candidates.
struct Method {
  enum class Source {
    // The service's answers.
    kService,
    // The service's candidates, less those that lie on the recent path.
    kServiceBeyondRecentPath,
    // FindNearestPositions(), on the nodes and checks of the method before it.
    kNearestPosition,
  };
  std::string name;
  Source source = Source::kService;
  v1::VehicleSettings settings;
  Judging judging;
  double sequence_length_meters = 0.0;
  // Standard deviations are claimed this many times as large as those of the
  // case; absent where claims are not swept.
  std::optional<double> claimed_scale;
};

// All methods in the order of the report. `main` becomes the index of the one
// whose drives are reported one by one.
std::vector<Method> ChooseMethods(const EvaluateOptions& options,
                                  std::size_t* main);

// Remarks on the methods for the readers of the report.
std::vector<std::string> NotesOn(const EvaluateOptions& options);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_METHODS_H_
