// Says for the API by what a vehicle's poses contradict its settings, or the
// server's clock.
#ifndef REVISIT_SERVER_CONVERSION_FINDINGS_H_
#define REVISIT_SERVER_CONVERSION_FINDINGS_H_

#include <cstdint>

#include "core/drive/findings.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "revisit/v1/vehicle.pb.h"
#include "server/sessions/append_request.h"

namespace revisit::server {

void EncodeFinding(const core::Finding& finding, v1::Finding* message);

// `sequence`: the last of the poses that show it.
void EncodeFindingWarning(const core::Finding& finding, std::uint64_t sequence,
                          v1::Warning* warning);

void EncodeStampWarning(const StampAhead& ahead, v1::Warning* warning);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_FINDINGS_H_
