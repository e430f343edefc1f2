#include "server/security/gatekeeper.h"

#include <utility>

namespace revisit::server {
namespace {

class OpenGatekeeper final : public Gatekeeper {
 public:
  bool asks() const override { return false; }
  absl::StatusOr<std::shared_ptr<const Caller>> Admit(const Credentials&,
                                                      Time) override {
    return everyone_;
  }
  WatchId Watch(Time, std::function<void()>) override { return -1; }
  void Unwatch(WatchId) override {}

 private:
  const std::shared_ptr<const Caller> everyone_ =
      std::make_shared<const Caller>();
};

}  // namespace

std::unique_ptr<Gatekeeper> MakeOpenGatekeeper() {
  return std::make_unique<OpenGatekeeper>();
}

}  // namespace revisit::server
