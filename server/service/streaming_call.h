// Calls with streams of messages: their reading and writing, beside the life of
// every call (call_reactor.h).
#ifndef REVISIT_SERVER_SERVICE_STREAMING_CALL_H_
#define REVISIT_SERVER_SERVICE_STREAMING_CALL_H_

#include "absl/status/status.h"
#include "core/base/mutex.h"
#include "grpcpp/support/byte_buffer.h"
#include "grpcpp/support/server_callback.h"
#include "server/base/status.h"
#include "server/service/call_reactor.h"
#include "server/service/message_bytes.h"

namespace revisit::server {

// The reading side. Messages are read as bytes, because gRPC reports one that
// it cannot parse like the end of the stream.
template <typename Base>
class Reading : public Base {
 public:
  using Base::Base;

  void OnReadDone(bool ok) final {
    this->CountMessage();
    if (ok) {
      OnMessage();
      return;
    }
    if (this->grpc_context_->IsCancelled()) this->MarkGivenUp();
    OnLastMessage();
  }

 protected:
  // REQUIRES: the call has not ended, and no message is being read.
  void ReadNext() { this->StartRead(&received_); }

  // Parses the message that has come and frees its bytes. INVALID_ARGUMENT
  // (STREAM_PROTOCOL) if it is none. Call once, from OnMessage() on.
  template <typename Message>
  absl::Status Parse(Message* message) {
    if (ParseMessage(&received_, message).ok()) return absl::OkStatus();
    return Error(absl::StatusCode::kInvalidArgument, "STREAM_PROTOCOL",
                 "a message of the stream is not a valid protobuf");
  }

  // Called without the mutex, also when the call has ended meanwhile.

  virtual void OnMessage() = 0;
  // No message will come any more: the caller has sent all, or given up.
  virtual void OnLastMessage() = 0;

 private:
  // Belongs to gRPC while a message is read.
  grpc::ByteBuffer received_;
};

// The writing side.
template <typename Base>
class Writing : public Base {
 public:
  using Base::Base;

  void OnWriteDone(bool ok) final {
    if (!ok) this->MarkGivenUp();
    const MutexLock lock(&this->mutex_);
    writing_ = false;
    if (!this->ended_) OnWritten();
  }

 protected:
  // Set `writing_` before. REQUIRES: no message is being written, and the call
  // does not end before this returns.
  template <typename Message>
  void Write(const Message& message,
             grpc::WriteOptions options = grpc::WriteOptions()) {
    WriteMessage(message, &sent_);
    this->StartWrite(&sent_, options);
  }

  // The message has gone out, or the call was given up.
  virtual void OnWritten() ABSL_EXCLUSIVE_LOCKS_REQUIRED(this->mutex_) = 0;

  // Whether a message is being written.
  bool writing_ ABSL_GUARDED_BY(this->mutex_) = false;

 private:
  // Belongs to gRPC while `writing_`.
  grpc::ByteBuffer sent_;
};

template <typename Self>
using ReadingCall =
    Reading<CallReactor<Self, grpc::ServerReadReactor<grpc::ByteBuffer>>>;
template <typename Self>
using WritingCall =
    Writing<CallReactor<Self, grpc::ServerWriteReactor<grpc::ByteBuffer>>>;
template <typename Self>
using BidiCall = Reading<Writing<CallReactor<
    Self, grpc::ServerBidiReactor<grpc::ByteBuffer, grpc::ByteBuffer>>>>;

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_STREAMING_CALL_H_
