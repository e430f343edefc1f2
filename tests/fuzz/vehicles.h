// Vehicles of all kinds, and what must hold of what they answer.
#ifndef REVISIT_TESTS_FUZZ_VEHICLES_H_
#define REVISIT_TESTS_FUZZ_VEHICLES_H_

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "server/sessions/record_codec.h"
#include "server/sessions/vehicle_config.h"
#include "tests/fuzz/fuzzing.h"

namespace revisit::fuzz {

inline constexpr int kVehicleKinds = 8;

// Each combination of state space, frame and whether it is a filter's.
server::VehicleConfig VehicleOfKind(int kind);

// An error for a caller: a reason, words, and no more than a trailer holds.
void RequireGoodError(const absl::Status& status);

// Builds the graph of a batch and searches it, if that is no more than a
// moment's work.
void Drive(const server::VehicleConfig& config,
           const std::vector<core::PoseSample>& samples);

}  // namespace revisit::fuzz

#endif  // REVISIT_TESTS_FUZZ_VEHICLES_H_
