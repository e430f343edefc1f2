// Tests of what storage.h promises, for any storage: instantiate
// StorageContract and GroupContract with a factory.
#ifndef REVISIT_TESTS_SERVER_STORAGE_STORAGE_CONTRACT_H_
#define REVISIT_TESTS_SERVER_STORAGE_STORAGE_CONTRACT_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <ostream>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "gtest/gtest.h"
#include "server/storage/storage.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {

// A store of one test.
class StoreUnderTest {
 public:
  virtual ~StoreUnderTest() = default;
  virtual Storage& storage() = 0;
  // Closes and opens it again. A storage that keeps nothing does nothing.
  virtual void Reopen() = 0;
  // Waits until all events that were written are told: a store that others use
  // too may keep them back while those write.
  virtual void AwaitEvents() {}
};

struct StoreFactory {
  std::string name;
  // Null if the machine lacks what it needs.
  std::function<std::unique_ptr<StoreUnderTest>()> make;
  // Whether groups are kept; false with the tables in a database that had no
  // room for them.
  bool keeps_groups = true;
};

inline void PrintTo(const StoreFactory& factory, std::ostream* stream) {
  *stream << factory.name;
}

// Names a test after its storage.
inline std::string NameOf(const ::testing::TestParamInfo<StoreFactory>& info) {
  return info.param.name;
}

class StorageContract : public ::testing::TestWithParam<StoreFactory> {
 protected:
  StorageContract() : store_(GetParam().make()) {}

  void SetUp() override {
    if (store_ == nullptr) GTEST_SKIP() << "what it needs is not installed";
  }

  Storage& storage() { return store_->storage(); }
  BlockingWrites write() { return BlockingWrites(&storage()); }
  GroupStorage& groups() { return storage().Groups(); }
  BlockingGroupWrites write_groups() { return BlockingGroupWrites(&storage()); }
  // As those of the storage, with all events that were written until now.
  absl::StatusOr<std::vector<EventRecord>> ReadEvents(
      const EventPosition& after, int limit) {
    store_->AwaitEvents();
    return storage().ReadEvents(after, limit);
  }
  absl::StatusOr<EventPosition> LastEvent() {
    store_->AwaitEvents();
    return storage().LastEvent();
  }
  absl::Status DropEvents(std::int64_t before_ns, int most) {
    store_->AwaitEvents();
    return write().DropEvents(before_ns, most);
  }

  const std::unique_ptr<StoreUnderTest> store_;
};

// The same of group_storage.h.
class GroupContract : public StorageContract {
 protected:
  void SetUp() override {
    StorageContract::SetUp();
    if (!IsSkipped() && !GetParam().keeps_groups) {
      GTEST_SKIP() << "the version before has no tables for groups";
    }
  }

  std::uint64_t RevisionOf(const std::string& id);
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_STORAGE_STORAGE_CONTRACT_H_
