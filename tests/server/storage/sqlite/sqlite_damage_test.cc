#include <cstdint>
#include <fstream>
#include <memory>
#include <optional>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/storage/sqlite/store_check.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage/sqlite/sqlite_testing.h"
#include "tests/server/storage_testing.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

TEST_F(SqliteStorageTest, DamageOfASnapshotIsFoundWhereverItIs) {
  for (const std::string& damage : std::vector<std::string>{
           "UPDATE snapshots SET payload = 'resT'",
           "UPDATE snapshots SET last_sequence = 5",
           "UPDATE snapshots SET part_count = 1",
           "UPDATE snapshots SET part_count = 3",
           "UPDATE snapshots SET format = 4",
           "UPDATE snapshots SET checksum = checksum + 1",
           "UPDATE snapshot_parts SET payload = 'onE' WHERE number = 0",
           "UPDATE snapshot_parts SET payload = '' WHERE number = 1",
           "UPDATE snapshot_parts SET format = 4 WHERE number = 1",
           "UPDATE snapshot_parts SET number = 2 WHERE number = 1",
           "UPDATE snapshot_parts SET number = 7 - number",
           "UPDATE snapshot_parts SET snapshot_key = 2",
           "DELETE FROM snapshot_parts WHERE number = 0"}) {
    SCOPED_TRACE(damage);
    RemoveStore();
    const VehicleKey key = MakeStore();
    {
      const std::unique_ptr<Storage> storage = MustOpen(Path());
      BlockingWrites write(storage.get());
      ASSERT_THAT(write.PutSnapshotPart(key, 0, "one"), IsOk());
      ASSERT_THAT(write.PutSnapshotPart(key, 1, "two"), IsOk());
      ASSERT_THAT(write.PutSnapshot(key, {6, 2, "rest"}), IsOk());
      ASSERT_EQ(SnapshotOf(*storage, key), "to 6: one two, 'rest'");
    }
    RunSql(Path(), damage);
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    EXPECT_THAT(SnapshotOf(*storage, key), HasSubstr("damaged"));
    // The poses are as they were.
    EXPECT_EQ(ReadAll(*storage, key, 1, 6)->size(), 3u);
  }
}

TEST_F(SqliteStorageTest, DamageOfMarksIsFoundWhereverItIs) {
  for (const std::string& damage : std::vector<std::string>{
           "UPDATE snapshot_parts SET payload = 'markS'",
           "UPDATE snapshot_parts SET payload = ''",
           "UPDATE snapshot_parts SET format = 4",
           "UPDATE snapshot_parts SET checksum = checksum + 1",
           // The marks of the other vehicle take the place of this one's.
           "DELETE FROM snapshot_parts WHERE snapshot_key = 1; "
           "UPDATE snapshot_parts SET snapshot_key = 1"}) {
    SCOPED_TRACE(damage);
    RemoveStore();
    const VehicleKey key = MakeStore();
    {
      const std::unique_ptr<Storage> storage = MustOpen(Path());
      BlockingWrites write(storage.get());
      ASSERT_THAT(write.PutMarks(key, "marks"), IsOk());
      ASSERT_THAT(write.PutMarks(*write.Create("other"), "others"), IsOk());
    }
    RunSql(Path(), damage);
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    EXPECT_EQ(MarksOf(*storage, key), "damaged");
    EXPECT_EQ(ReadAll(*storage, key, 1, 6)->size(), 3u);
  }
}

TEST_F(SqliteStorageTest, NamesBatchWhosePayloadIsDamaged) {
  const VehicleKey key = MakeStore();
  RunSql(Path(),
         "UPDATE batches SET payload = 'betA' WHERE first_sequence = 3");
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  const absl::Status status = ReadAll(*storage, key, 1, 6).status();
  EXPECT_THAT(status, IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                              AllOf(HasSubstr("vehicle 'truck'"),
                                    HasSubstr("sequences 3 to 4"),
                                    HasSubstr("fails its checksum"))));
  EXPECT_EQ(MetadataOf(status, "vehicle"), "truck");
  EXPECT_EQ(MetadataOf(status, "first_sequence"), "3");
  // The others are as they were.
  EXPECT_THAT(ToTexts(*ReadAll(*storage, key, 1, 2)),
              ElementsAre("1+2, revision 2, 'alpha'"));
  EXPECT_THAT(ToTexts(*ReadAll(*storage, key, 5, 6)),
              ElementsAre("5+2, revision 5, 'GAMMA'"));
}

TEST_F(SqliteStorageTest, FindsDamageOfEveryColumn) {
  const std::vector<std::string> damages = {
      "UPDATE batches SET payload = substr(payload, 2) WHERE first_sequence=3",
      "UPDATE batches SET revision = 9 WHERE first_sequence = 3",
      "UPDATE batches SET count = 1 WHERE first_sequence = 3",
      "UPDATE batches SET count = 4294967298 WHERE first_sequence = 3",
      "UPDATE batches SET format = 4 WHERE first_sequence = 3",
      "UPDATE batches SET checksum = checksum + 1 WHERE first_sequence = 3",
      "UPDATE batches SET first_sequence = 2 WHERE first_sequence = 3",
      "UPDATE batches SET payload = (SELECT payload FROM batches WHERE "
      "first_sequence = 1), checksum = (SELECT checksum FROM batches WHERE "
      "first_sequence = 1) WHERE first_sequence = 3",
      "DELETE FROM batches WHERE first_sequence = 3",
      "DELETE FROM batches WHERE first_sequence = 1",
      "UPDATE revised_batches SET payload = 'GAMMa'",
      "UPDATE revised_batches SET count = 1",
      "UPDATE revised_batches SET revision = 9",
  };
  for (const std::string& damage : damages) {
    SCOPED_TRACE(damage);
    RemoveStore();
    const VehicleKey key = MakeStore();
    RunSql(Path(), damage);
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    EXPECT_THAT(
        ReadAll(*storage, key, 1, 6),
        IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("'truck'")));
  }
}

TEST_F(SqliteStorageTest, FindsDamageOfVehicle) {
  for (const char* damage :
       {"UPDATE vehicles SET payload = 'Payload'",
        "UPDATE vehicles SET revision = 5", "UPDATE vehicles SET format = 10",
        "UPDATE vehicles SET key = 2",
        // The last batch says how far the vehicle goes.
        "UPDATE batches SET count = 3 WHERE first_sequence = 5",
        "UPDATE batches SET revision = 3 WHERE first_sequence = 5"}) {
    SCOPED_TRACE(damage);
    RemoveStore();
    MakeStore();
    RunSql(Path(), damage);
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    const auto corrupt = IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                                 HasSubstr("vehicle 'truck'"));
    // It is told of this one alone, and it can be deleted and made again.
    const VehicleKey sound = *BlockingWrites(storage.get()).Create("sound");
    const absl::StatusOr<VehicleRecord> record = storage->GetVehicle("truck");
    ASSERT_THAT(record, IsOk());
    EXPECT_THAT(record->damage, corrupt);
    const auto listed = storage->ListVehicles("", "", 10);
    ASSERT_THAT(listed, IsOk());
    ASSERT_EQ(listed->size(), 2u);
    EXPECT_EQ((*listed)[0].key, sound);
    EXPECT_THAT((*listed)[0].damage, IsOk());
    EXPECT_THAT((*listed)[1].damage, corrupt);
    const auto both = storage->GetVehicles({"sound", "truck"});
    ASSERT_THAT(both, IsOk());
    ASSERT_EQ(both->size(), 2u);
    EXPECT_THAT((*both)[0].damage, IsOk());
    EXPECT_THAT((*both)[1].damage, corrupt);
    BlockingWrites write(storage.get());
    EXPECT_THAT(write.Delete(record->key), IsOk());
    const absl::StatusOr<VehicleKey> again = write.Create("truck");
    ASSERT_THAT(again, IsOk());
    EXPECT_THAT(storage->GetVehicle("truck")->damage, IsOk());
    EXPECT_THAT(write.Append(*again, {1, 1, 2, "a"}), IsOk());
  }
}

TEST_F(SqliteStorageTest, GivesUpWhatIsDamaged) {
  for (const char* damage :
       {"UPDATE batches SET payload = 'x' WHERE first_sequence = 5",
        "UPDATE batches SET revision = 99 WHERE first_sequence = 3",
        // The revision is sound, what it revises is not.
        "UPDATE revised_batches SET payload = 'x'",
        "DELETE FROM batches WHERE first_sequence = 3"}) {
    SCOPED_TRACE(damage);
    RemoveStore();
    const VehicleKey key = MakeStore();
    RunSql(Path(), damage);
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    BlockingWrites write(storage.get());
    std::uint64_t sound = 0;
    EXPECT_THAT(storage->ReadBatches(key, 1, 6, BatchVersion::kCurrent,
                                     [&](const BatchRecord& batch) {
                                       sound = batch.first_sequence +
                                               batch.count - 1;
                                       return true;
                                     }),
                IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
    ASSERT_LT(sound, 6u);
    EXPECT_THAT(write.DropDamaged(key, sound, "new", 30), IsOk());
    const VehicleRecord record = *storage->GetVehicle("truck");
    EXPECT_THAT(record.damage, IsOk());
    EXPECT_EQ(record.durable_sequence, sound);
    EXPECT_EQ(record.revision, 30u);
    EXPECT_THAT(ReadAll(*storage, key, 1, sound), IsOk());
    EXPECT_THAT(write.Append(key, {sound + 1, 1, 31, "a"}), IsOk());
  }
  // A damaged pair goes alone.
  RemoveStore();
  const VehicleKey key = MakeStore();
  RunSql(Path(), "UPDATE loop_closures SET create_time_ns = 98");
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  EXPECT_THAT(BlockingWrites(storage.get()).DropDamaged(key, 6, "new", 30),
              IsOk());
  EXPECT_EQ(storage->GetVehicle("truck")->loop_closure_count, 0);
  EXPECT_EQ(storage->GetVehicle("truck")->rejected_candidate_count, 1);
}

TEST_F(SqliteStorageTest, FindsDamageOfPairs) {
  for (const auto& [kind, table] :
       {std::pair(PairKind::kLoopClosure, "loop_closures"),
        std::pair(PairKind::kRejectedCandidate, "rejected_candidates")}) {
    for (const char* damage :
         {"query_sequence = 5", "matched_sequence = 3", "create_time_ns = 98",
          "id = 'lint'", "format = 1", "payload = 'x'"}) {
      const std::string sql = "UPDATE " + std::string(table) + " SET " + damage;
      SCOPED_TRACE(sql);
      RemoveStore();
      const VehicleKey key = MakeStore();
      RunSql(Path(), sql);
      const std::unique_ptr<Storage> storage = MustOpen(Path());
      const auto pairs = storage->ListPosePairs(key, kind, "", 10);
      ASSERT_THAT(pairs, IsOk());
      ASSERT_EQ(pairs->size(), 1u);
      EXPECT_THAT(
          pairs->front().damage,
          IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                  AllOf(HasSubstr(WordsOf(kind).noun), HasSubstr("'truck'"))));
    }
  }
}

TEST_F(SqliteStorageTest, FindsAndGivesUpDamageOfDeletedPairs) {
  for (const char* damage :
       {"number = 3", "kind = 1", "kind = 3", "id = 'lint'", "format = 1",
        "query_sequence = 5", "matched_sequence = 3", "create_time_ns = 98",
        "delete_time_ns = 98", "payload = 'x'"}) {
    SCOPED_TRACE(damage);
    RemoveStore();
    const VehicleKey key = MakeStore();
    {
      const std::unique_ptr<Storage> storage = MustOpen(Path());
      BlockingWrites write(storage.get());
      ASSERT_THAT(write.DeletePair(key, PairKind::kLoopClosure, "link", 8),
                  IsOk());
      ASSERT_THAT(write.DeletePair(key, PairKind::kRejectedCandidate, "no", 9),
                  IsOk());
    }
    RunSql(Path(), "UPDATE deleted_pose_pairs SET " + std::string(damage) +
                       " WHERE number = 2");
    EXPECT_THAT(CheckStore(Path(), StoreUse::kIdle)->damaged_vehicles,
                ElementsAre("truck"));
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    EXPECT_THAT(storage->ListDeletedPairs(key)->front().pair.damage,
                IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                        HasSubstr("of vehicle 'truck'")));
    ASSERT_THAT(BlockingWrites(storage.get()).DropDamaged(key, 6, "new", 30),
                IsOk());
    EXPECT_THAT(ToTexts(*storage->ListDeletedPairs(key)),
                ElementsAre("1, closure link: 0 at 0, 0 ns, deleted at 0 ns"));
  }
}

TEST_F(SqliteStorageTest, FindsAndGivesUpDamageOfChecks) {
  struct Case {
    const char* damage;
    // The head and the checks that are left.
    const char* left;
  };
  for (const Case& one : {
           Case{"UPDATE checks SET payload = 'x' WHERE sequence = 3", "5: b"},
           Case{"UPDATE checks SET sequence = 4 WHERE sequence = 3", "5: b"},
           Case{"UPDATE checks SET open_count = 0", ""},
           Case{"UPDATE checks SET revision = 9 WHERE sequence = 5", "3: a"},
           Case{"UPDATE check_heads SET checked_sequence = 2", "3: a 5: b"},
           Case{"UPDATE check_heads SET last_event = 7", "3: a 5: b"},
           Case{"UPDATE check_heads SET stores = 0", "3: a 5: b"},
       }) {
    SCOPED_TRACE(one.damage);
    RemoveStore();
    const VehicleKey key = MakeStore();
    ChecksWrite checks;
    checks.after = {true, 5, 1};
    checks.checks = {{3, 7, 1, 1, "a"}, {5, 7, 1, 2, "b"}};
    checks.events.emplace_back();
    checks.events.back().payload = "told";
    ASSERT_THAT(BlockingWrites(MustOpen(Path()).get()).PutChecks(key, checks),
                IsOk());
    RunSql(Path(), one.damage);
    EXPECT_THAT(CheckStore(Path(), StoreUse::kIdle)->damaged_vehicles,
                ElementsAre("truck"));
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    ASSERT_THAT(BlockingWrites(storage.get()).DropDamaged(key, 6, "new", 30),
                IsOk());
    const auto record = storage->GetVehicle("truck");
    EXPECT_THAT(record->damage, IsOk());
    EXPECT_EQ(record->checks, (ChecksHead{true, 5, 1}));
    std::string left;
    const auto checks_left = storage->ListChecks(key, 1, 9, false, 9);
    ASSERT_THAT(checks_left, IsOk());
    for (const CheckRecord& check : *checks_left) {
      EXPECT_THAT(check.damage, IsOk());
      left += (left.empty() ? "" : " ") + std::to_string(check.sequence) +
              ": " + check.payload;
    }
    EXPECT_EQ(left, one.left);
  }
}

TEST_F(SqliteStorageTest, ReadsAnEventThatIsDamagedAsDamaged) {
  const VehicleKey key = MakeStore();
  ChecksWrite checks;
  checks.after = {true, 5, 1};
  checks.events.emplace_back();
  checks.events.back().payload = "told";
  ASSERT_THAT(BlockingWrites(MustOpen(Path()).get()).PutChecks(key, checks),
              IsOk());
  RunSql(Path(), "UPDATE events SET payload = 'lied'");
  const auto events = MustOpen(Path())->ReadEvents({}, 9);
  ASSERT_THAT(events, IsOk());
  ASSERT_EQ(events->size(), 1u);
  EXPECT_THAT(events->front().damage,
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  EXPECT_EQ(events->front().payload, "");
}

TEST_F(SqliteStorageTest, FindsPairThatEndedUpInTheTableOfAnotherKind) {
  const VehicleKey key = MakeStore();
  RunSql(Path(), "INSERT INTO rejected_candidates SELECT * FROM loop_closures");
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  const absl::Status status =
      storage->ListPosePairs(key, PairKind::kRejectedCandidate, "", 10)
          ->front()
          .damage;
  EXPECT_THAT(status,
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                      "stored rejected candidate 'link' of vehicle 'truck' "
                      "fails its checksum"));
  EXPECT_EQ(MetadataOf(status, "rejected_candidate"), "link");
}

TEST_F(SqliteStorageTest, DamageOfOneVehicleDoesNotStopTheOthers) {
  const VehicleKey damaged = MakeStore();
  RunSql(Path(), "UPDATE batches SET payload = 'x' WHERE first_sequence = 5");
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  const VehicleKey sound = *BlockingWrites(storage.get()).Create("car");
  const Answer<absl::Status> refused;
  const Answer<absl::Status> written;
  AppendBatch(*storage, damaged, {7, 1, 7, "x"}, std::nullopt,
              refused.Setter());
  AppendBatch(*storage, sound, {1, 1, 2, "x"}, std::nullopt, written.Setter());
  EXPECT_THAT(refused.Get(),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  EXPECT_THAT(written.Get(), IsOk());
}

TEST_F(SqliteStorageTest, FindsDamageInTheFileItself) {
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    BlockingWrites write(storage.get());
    const VehicleKey key = *write.Create("truck");
    for (std::uint64_t i = 1; i <= 20; ++i) {
      ASSERT_THAT(write.Append(key, {i, 1, i + 1, std::string(9000, 'x')}),
                  IsOk());
    }
  }
  // Some byte of a payload, wherever it lies.
  std::string bytes;
  {
    std::ifstream in(Path(), std::ios::binary);
    std::stringstream all;
    all << in.rdbuf();
    bytes = all.str();
  }
  const std::size_t place = bytes.find(std::string(3000, 'x'));
  ASSERT_NE(place, std::string::npos);
  bytes[place + 1500] ^= 1;
  std::ofstream(Path(), std::ios::binary) << bytes;
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  EXPECT_THAT(ReadAll(*storage, 1, 1, 20),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                      HasSubstr("fails its checksum")));
}

}  // namespace
}  // namespace revisit::server
