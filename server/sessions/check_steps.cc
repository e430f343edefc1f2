#include "server/sessions/check_steps.h"

#include <utility>

#include "server/storage/storage.h"

namespace revisit::server {

void CheckSteps::Run(Step step, std::function<void(bool)> then) {
  queue_->PushBack(
      {Turn::kAlone, [this, step = std::move(step),
                      then = std::move(then)](const absl::Status& status) {
         if (!status.ok() || !changes_->MayWork()) {
           then(false);
           return;
         }
         queue_->Hold();
         queue_->PostLong([this, step, then] { Begin(step, then); });
       }});
  queue_->PumpLater();
}

void CheckSteps::Begin(const Step& step,
                       const std::function<void(bool)>& then) {
  absl::StatusOr<ChecksWrite> write = step();
  if (!write.ok()) {
    queue_->Release([&] { then(false); });
    return;
  }
  if (write->checks.empty() && write->events.empty() &&
      write->removed.empty()) {
    queue_->Release([&] { then(true); });
    return;
  }
  const ChecksHead after = write->after;
  vehicle_->storage->PutChecks(
      vehicle_->head.key(), *std::move(write),
      queue_->OnStrand([this, after, then](const absl::Status& put) {
        if (put.ok()) {
          vehicle_->head.set_checks(after);
        } else {
          vehicle_->NoteFailedWrite(put);
        }
        queue_->Release([&] { then(put.ok()); });
      }));
}

}  // namespace revisit::server
