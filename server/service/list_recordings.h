// The handler of ListRecordings, a UnaryHandler (unary_call.h).
#ifndef REVISIT_SERVER_SERVICE_LIST_RECORDINGS_H_
#define REVISIT_SERVER_SERVICE_LIST_RECORDINGS_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/unary_call.h"

namespace revisit::server {

absl::Status ListRecordings(const ServiceContext& service,
                            const UnaryCallPtr& call,
                            const v1::ListRecordingsRequest& request,
                            v1::ListRecordingsResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_LIST_RECORDINGS_H_
