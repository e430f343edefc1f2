// Which loop closures of a vehicle contradict others, by name.
#ifndef REVISIT_SERVER_SESSIONS_CONTRADICTED_CLOSURES_H_
#define REVISIT_SERVER_SESSIONS_CONTRADICTED_CLOSURES_H_

#include <string>
#include <utility>
#include <vector>

#include "core/drive/suspects.h"
#include "server/sessions/vehicle_view.h"

namespace revisit::server {

// A loop closure's id, and core::Suspect::p_value.
using ContradictedClosure = std::pair<std::string, double>;

// Names the suspects that were found among these closures; the least probable
// first.
std::vector<ContradictedClosure> NameSuspects(
    const PosePairs& closures, const std::vector<core::Suspect>& suspects);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_CONTRADICTED_CLOSURES_H_
