#include "tests/server/memory_storage.h"

#include <memory>

#include "gtest/gtest.h"
#include "tests/server/storage/storage_contract.h"

namespace revisit::server {
namespace {

class MemoryStore : public StoreUnderTest {
 public:
  Storage& storage() override { return storage_; }
  void Reopen() override {}

 private:
  MemoryStorage storage_;
};

StoreFactory Factory() {
  return {"Memory", [] { return std::make_unique<MemoryStore>(); }};
}

INSTANTIATE_TEST_SUITE_P(Memory, StorageContract, ::testing::Values(Factory()),
                         NameOf);
INSTANTIATE_TEST_SUITE_P(Memory, GroupContract, ::testing::Values(Factory()),
                         NameOf);

}  // namespace
}  // namespace revisit::server
