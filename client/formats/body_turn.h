// Finds how the axes of a recording's body lie in its vehicle: a vehicle moves
// forward, and its up is the frame's z.
#ifndef REVISIT_CLIENT_FORMATS_BODY_TURN_H_
#define REVISIT_CLIENT_FORMATS_BODY_TURN_H_

#include <array>
#include <cstdint>
#include <optional>
#include <string>

#include "client/formats/axes.h"
#include "client/formats/sample.h"

namespace revisit::client {

// Where the vehicle's forward and up point in the body, over steps of one
// length.
class BodyTurn {
 public:
  explicit BodyTurn(double step_meters) : step_meters_(step_meters) {}

  // Takes a sample whose frame has z up, and whose body is as in the file.
  void Add(const Sample& sample);

  // How the body is turned, and the flags for it.
  struct Finding {
    // Root mean square of the angle between forward and the direction of
    // travel, in degrees, that is left then.
    double spread_degrees = 0.0;
    std::string flags;
    std::string words;
  };
  // Absent where steps disagree, are too few, or show that nothing is turned.
  std::optional<Finding> Find() const;

 private:
  const double step_meters_;
  std::optional<Sample> anchor_;
  std::int64_t steps_ = 0;
  bool has_quaternions_ = false;
  // Sums of unit vectors.
  std::array<double, 3> forward_{};
  std::array<double, 3> up_{};
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_BODY_TURN_H_
