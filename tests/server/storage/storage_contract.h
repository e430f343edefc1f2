// Tests of what storage.h promises, for any storage: instantiate
// StorageContract with a factory.
#ifndef REVISIT_TESTS_SERVER_STORAGE_STORAGE_CONTRACT_H_
#define REVISIT_TESTS_SERVER_STORAGE_STORAGE_CONTRACT_H_

#include <functional>
#include <memory>
#include <ostream>
#include <string>

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
};

struct StoreFactory {
  std::string name;
  // Null if the machine lacks what it needs.
  std::function<std::unique_ptr<StoreUnderTest>()> make;
  // Whether pairs that are deleted are kept; false with the tables in a
  // database that had no room for them.
  bool keeps_deleted_pairs = true;
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

  const std::unique_ptr<StoreUnderTest> store_;
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_STORAGE_STORAGE_CONTRACT_H_
