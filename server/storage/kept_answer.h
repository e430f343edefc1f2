// Carries the answer of a write through a queue of writes, which end with a
// status alone.
//
// The copies of one of these share the answer: Keep() it in the write, and give
// the queue Then() of what is to be called with it.
#ifndef REVISIT_SERVER_STORAGE_KEPT_ANSWER_H_
#define REVISIT_SERVER_STORAGE_KEPT_ANSWER_H_

#include <functional>
#include <memory>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/records.h"

namespace revisit::server {

template <typename T>
class KeptAnswer {
 public:
  // Returns the status. The answer of the last attempt counts.
  absl::Status Keep(absl::StatusOr<T> answer) const {
    if (!answer.ok()) return answer.status();
    *kept_ = *std::move(answer);
    return absl::OkStatus();
  }

  // A call of `done` with the answer, or with the error that the write ended
  // with.
  WriteDone Then(std::function<void(absl::StatusOr<T>)> done) const {
    return [kept = kept_, done = std::move(done)](absl::Status status) {
      if (!status.ok()) {
        done(std::move(status));
      } else {
        done(std::move(*kept));
      }
    };
  }

 private:
  std::shared_ptr<T> kept_ = std::make_shared<T>();
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_KEPT_ANSWER_H_
