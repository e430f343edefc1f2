#include "server/service/reflection.h"

#include <google/protobuf/descriptor.h>
#include <google/protobuf/descriptor.pb.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <list>
#include <memory>
#include <mutex>
#include <unordered_map>
#include <unordered_set>
#include <utility>

#include "core/base/mutex.h"
#include "grpc/reflection/v1/reflection.grpc.pb.h"
#include "grpc/reflection/v1alpha/reflection.grpc.pb.h"
#include "grpcpp/server_context.h"
#include "grpcpp/support/server_callback.h"

// The descriptors of all services, made by the build (proto/CMakeLists.txt).
extern "C" {
extern const unsigned char kRevisitServedDescriptors[];
extern const std::size_t kRevisitServedDescriptorsSize;
}

namespace revisit::server {
namespace {

namespace protobuf = google::protobuf;

// Streams at a time. Each holds at most one answer, of up to half a megabyte.
constexpr std::size_t kMaxStreams = 32;

// Removes the JSON names, because with them grpcurl would write other names
// than those of the protos.
void ClearJsonNames(protobuf::DescriptorProto* message) {
  for (auto& field : *message->mutable_field()) field.clear_json_name();
  for (auto& field : *message->mutable_extension()) field.clear_json_name();
  for (auto& nested : *message->mutable_nested_type()) ClearJsonNames(&nested);
}

// All descriptors. Immutable, so that threads may share it.
class Catalog {
 public:
  Catalog() {
    protobuf::FileDescriptorSet set;
    set.ParseFromArray(kRevisitServedDescriptors,
                       static_cast<int>(kRevisitServedDescriptorsSize));
    // Each file comes after those that it imports.
    for (auto& file : *set.mutable_file()) {
      for (auto& message : *file.mutable_message_type()) {
        ClearJsonNames(&message);
      }
      for (auto& field : *file.mutable_extension()) field.clear_json_name();
      pool_.BuildFile(file);
      serialized_[file.name()] = file.SerializeAsString();
    }
  }

  const protobuf::DescriptorPool& pool() const { return pool_; }
  const std::string& Serialized(const std::string& name) const {
    return serialized_.at(name);
  }

 private:
  protobuf::DescriptorPool pool_;
  std::unordered_map<std::string, std::string> serialized_;
};

// The streams that are open. Thread-safe.
class OpenStreams {
 public:
  void Enter(grpc::CallbackServerContext* context) {
    const MutexLock lock(&mutex_);
    if (open_.size() >= kMaxStreams) {
      open_.front()->TryCancel();
      open_.pop_front();
    }
    open_.push_back(context);
  }
  // Once this returns, the context is not touched any more.
  void Leave(grpc::CallbackServerContext* context) {
    const MutexLock lock(&mutex_);
    open_.remove(context);
  }

 private:
  Mutex mutex_;
  // The oldest first.
  std::list<grpc::CallbackServerContext*> open_ ABSL_GUARDED_BY(mutex_);
};

// The state that all streams have in common. Thread-safe.
class Shared {
 public:
  explicit Shared(std::vector<std::string> services)
      : services_(std::move(services)) {}

  // Full names of the services.
  const std::vector<std::string>& services() const { return services_; }
  // Made when it is first asked for, because that takes milliseconds and
  // megabytes, and many a server is never asked.
  const Catalog& catalog() {
    std::call_once(made_, [this] { catalog_ = std::make_unique<Catalog>(); });
    return *catalog_;
  }
  OpenStreams& streams() { return streams_; }

 private:
  const std::vector<std::string> services_;
  std::once_flag made_;
  std::unique_ptr<const Catalog> catalog_;
  OpenStreams streams_;
};

// Answers one request after another, each before the next is read. The messages
// of both versions have the same members.
template <typename Request, typename Response>
class Stream final : public grpc::ServerBidiReactor<Request, Response> {
 public:
  Stream(grpc::CallbackServerContext* context, std::shared_ptr<Shared> shared)
      : context_(context), shared_(std::move(shared)) {
    shared_->streams().Enter(context_);
    this->StartRead(&request_);
  }

  void OnReadDone(bool ok) override {
    if (!ok) {
      this->Finish(grpc::Status::OK);
      return;
    }
    response_.Clear();
    response_.set_valid_host(request_.host());
    *response_.mutable_original_request() = request_;
    Answer();
    this->StartWrite(&response_);
  }

  void OnWriteDone(bool ok) override {
    if (ok) {
      this->StartRead(&request_);
    } else {
      this->Finish(grpc::Status::OK);
    }
  }

  void OnDone() override {
    shared_->streams().Leave(context_);
    delete this;
  }

 private:
  const protobuf::DescriptorPool& pool() { return shared_->catalog().pool(); }

  void Answer() {
    switch (request_.message_request_case()) {
      case Request::kFileByFilename:
        return AnswerFile(pool().FindFileByName(request_.file_by_filename()));
      case Request::kFileContainingSymbol:
        return AnswerFile(
            pool().FindFileContainingSymbol(request_.file_containing_symbol()));
      case Request::kFileContainingExtension:
        return AnswerExtension();
      case Request::kAllExtensionNumbersOfType:
        return AnswerExtensionNumbers();
      case Request::kListServices:
        for (const std::string& name : shared_->services()) {
          response_.mutable_list_services_response()->add_service()->set_name(
              name);
        }
        return;
      default:
        return AnswerError(grpc::StatusCode::INVALID_ARGUMENT,
                           "the request asks for nothing that is known");
    }
  }

  void AnswerError(grpc::StatusCode code, const std::string& what) {
    response_.mutable_error_response()->set_error_code(code);
    response_.mutable_error_response()->set_error_message(what);
  }

  // Answers a file with all its imports, except imports that the stream has
  // sent before.
  void AnswerFile(const protobuf::FileDescriptor* file) {
    if (file == nullptr) {
      return AnswerError(grpc::StatusCode::NOT_FOUND, "there is none here");
    }
    auto* const answer = response_.mutable_file_descriptor_response();
    std::unordered_set<const protobuf::FileDescriptor*> added;
    std::vector<const protobuf::FileDescriptor*> waiting = {file};
    while (!waiting.empty()) {
      const protobuf::FileDescriptor* const one = waiting.back();
      waiting.pop_back();
      // The requested file itself is sent each time.
      if (!added.insert(one).second ||
          (!sent_.insert(one).second && one != file)) {
        continue;
      }
      answer->add_file_descriptor_proto(
          shared_->catalog().Serialized(one->name()));
      for (int i = 0; i < one->dependency_count(); ++i) {
        waiting.push_back(one->dependency(i));
      }
    }
  }

  void AnswerExtension() {
    const auto& asked = request_.file_containing_extension();
    const protobuf::Descriptor* const type =
        pool().FindMessageTypeByName(asked.containing_type());
    const protobuf::FieldDescriptor* const extension =
        type == nullptr
            ? nullptr
            : pool().FindExtensionByNumber(type, asked.extension_number());
    AnswerFile(extension == nullptr ? nullptr : extension->file());
  }

  void AnswerExtensionNumbers() {
    const std::string& name = request_.all_extension_numbers_of_type();
    const protobuf::Descriptor* const type = pool().FindMessageTypeByName(name);
    if (type == nullptr) {
      return AnswerError(grpc::StatusCode::NOT_FOUND, "there is none here");
    }
    auto* const answer = response_.mutable_all_extension_numbers_response();
    answer->set_base_type_name(name);
    std::vector<const protobuf::FieldDescriptor*> extensions;
    pool().FindAllExtensions(type, &extensions);
    for (const auto* extension : extensions) {
      answer->add_extension_number(extension->number());
    }
  }

  grpc::CallbackServerContext* const context_;
  const std::shared_ptr<Shared> shared_;
  std::unordered_set<const protobuf::FileDescriptor*> sent_;
  Request request_;
  Response response_;
};

template <typename Service, typename Request, typename Response>
class ReflectionService final : public Service::CallbackService {
 public:
  explicit ReflectionService(std::shared_ptr<Shared> shared)
      : shared_(std::move(shared)) {}

  grpc::ServerBidiReactor<Request, Response>* ServerReflectionInfo(
      grpc::CallbackServerContext* context) override {
    return new Stream<Request, Response>(context, shared_);
  }

 private:
  const std::shared_ptr<Shared> shared_;
};

}  // namespace

std::vector<std::unique_ptr<grpc::Service>> MakeReflectionServices(
    std::vector<std::string> served) {
  namespace v1 = grpc::reflection::v1;
  namespace v1alpha = grpc::reflection::v1alpha;
  served.emplace_back(v1::ServerReflection::service_full_name());
  served.emplace_back(v1alpha::ServerReflection::service_full_name());
  const auto shared = std::make_shared<Shared>(std::move(served));
  std::vector<std::unique_ptr<grpc::Service>> services;
  services.push_back(
      std::make_unique<
          ReflectionService<v1::ServerReflection, v1::ServerReflectionRequest,
                            v1::ServerReflectionResponse>>(shared));
  services.push_back(
      std::make_unique<ReflectionService<v1alpha::ServerReflection,
                                         v1alpha::ServerReflectionRequest,
                                         v1alpha::ServerReflectionResponse>>(
          shared));
  return services;
}

}  // namespace revisit::server
