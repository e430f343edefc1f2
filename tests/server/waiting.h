// Waits in tests for what other threads answer.
#ifndef REVISIT_TESTS_SERVER_WAITING_H_
#define REVISIT_TESTS_SERVER_WAITING_H_

#include <chrono>
#include <condition_variable>
#include <cstdlib>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <thread>
#include <utility>

namespace revisit::server {

// One value that is set once. Copies share it.
template <typename T>
class Answer {
 public:
  void Set(T value) const {
    const std::lock_guard<std::mutex> guard(state_->mutex);
    if (state_->value) std::abort();
    state_->value.emplace(std::move(value));
    state_->set.notify_all();
  }

  bool IsSet() const {
    const std::lock_guard<std::mutex> guard(state_->mutex);
    return state_->value.has_value();
  }

  // Waits.
  T Get() const {
    std::unique_lock<std::mutex> lock(state_->mutex);
    state_->set.wait(lock, [this] { return state_->value.has_value(); });
    return *state_->value;
  }

  // Sets it.
  std::function<void(T)> Setter() const {
    return [answer = *this](T value) { answer.Set(std::move(value)); };
  }

 private:
  struct State {
    std::mutex mutex;
    std::condition_variable set;
    std::optional<T> value;
  };
  std::shared_ptr<State> state_ = std::make_shared<State>();
};

// Whether a condition that nothing announces comes true within a minute, which
// is longer than anything takes that does not hang.
inline bool Eventually(const std::function<bool()>& condition) {
  const auto latest =
      std::chrono::steady_clock::now() + std::chrono::minutes(1);
  while (!condition()) {
    if (std::chrono::steady_clock::now() > latest) return false;
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
  }
  return true;
}

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_WAITING_H_
