// Names of resources and of enum values, as people write and read them.
#ifndef REVISIT_CLIENT_CLI_NAMES_H_
#define REVISIT_CLIENT_CLI_NAMES_H_

#include <string>

#include "revisit/v1/candidate.pb.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

// "vehicles/ID" for ID; a resource name stays as it is.
std::string VehicleName(const std::string& id);

// The value's name without its prefix, such as "PLANAR".
std::string NameOf(v1::StateSpace value);
std::string NameOf(v1::CorrelationModel value);
std::string NameOf(v1::LikelihoodForm value);
std::string NameOf(v1::Alignment value);
std::string NameOf(v1::CoordinateFrame value);
std::string NameOf(v1::VehicleState value);
std::string NameOf(v1::GateVerdict value);
std::string NameOf(v1::Verdict value);
std::string NameOf(v1::Direction value);

// Why there are no candidates, in words.
std::string Explain(v1::EmptyReason reason);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_NAMES_H_
