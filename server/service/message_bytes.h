// Parses messages from gRPC's buffers and serializes them into these.
#ifndef REVISIT_SERVER_SERVICE_MESSAGE_BYTES_H_
#define REVISIT_SERVER_SERVICE_MESSAGE_BYTES_H_

#include "absl/status/status.h"
#include "grpcpp/impl/codegen/proto_utils.h"
#include "grpcpp/support/byte_buffer.h"
#include "server/base/status.h"

namespace revisit::server {

// Parses the one message of a call and frees its bytes. INVALID_ARGUMENT
// (MALFORMED_MESSAGE) if they are not valid.
template <typename Message>
absl::Status ParseMessage(const grpc::ByteBuffer* bytes, Message* message) {
  // gRPC no longer needs the bytes, but would keep them until the call ends.
  auto* const taken = const_cast<grpc::ByteBuffer*>(bytes);
  if (grpc::SerializationTraits<Message>::Deserialize(taken, message).ok()) {
    return absl::OkStatus();
  }
  return Error(absl::StatusCode::kInvalidArgument, "MALFORMED_MESSAGE",
               "the request is not a valid protobuf of the type " +
                   Message::descriptor()->full_name());
}

template <typename Message>
void WriteMessage(const Message& message, grpc::ByteBuffer* bytes) {
  // gRPC ends the process over a buffer that still holds something.
  bytes->Clear();
  bool own_buffer;
  // This fails only if a message is larger than 2 GiB.
  const grpc::Status status = grpc::SerializationTraits<Message>::Serialize(
      message, bytes, &own_buffer);
  if (!status.ok()) bytes->Clear();
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_MESSAGE_BYTES_H_
