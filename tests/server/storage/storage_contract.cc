#include "tests/server/storage/storage_contract.h"

#include <algorithm>
#include <atomic>
#include <map>
#include <mutex>
#include <optional>
#include <random>
#include <set>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/memory_storage.h"
#include "tests/server/waiting.h"

namespace revisit::server {

using absl::StatusCode;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::IsEmpty;

namespace {

BatchRecord Batch(std::uint64_t first, std::uint32_t count,
                  std::uint64_t revision, const std::string& payload) {
  return BatchRecord{first, count, revision, payload};
}

// A step of checks that moves a vehicle's head on.
ChecksWrite Step(const ChecksHead& before, std::uint64_t checked,
                 std::vector<CheckRecord> checks,
                 std::vector<EventRecord> events) {
  ChecksWrite write;
  write.before = before;
  write.after = {true, checked, before.last_event + events.size()};
  write.checks = std::move(checks);
  write.events = std::move(events);
  return write;
}

EventRecord Event(std::int64_t time_ns, const std::string& payload) {
  EventRecord event;
  event.number = 77;  // Not read.
  event.time_ns = time_ns;
  event.payload = payload;
  return event;
}

}  // namespace

TEST_P(StorageContract, ReadsBackWhatWasCreated) {
  // Bytes of every value, the zero byte too.
  std::string payload;
  for (int i = 0; i < 256; ++i) payload.push_back(static_cast<char>(i));
  const absl::StatusOr<VehicleKey> key = write().Create("truck", payload, 7);
  ASSERT_THAT(key, IsOk());
  store_->Reopen();
  const absl::StatusOr<VehicleRecord> record = storage().GetVehicle("truck");
  ASSERT_THAT(record, IsOk());
  EXPECT_EQ(record->key, *key);
  EXPECT_EQ(record->id, "truck");
  EXPECT_EQ(record->payload, payload);
  EXPECT_EQ(record->revision, 7u);
  EXPECT_EQ(record->durable_sequence, 0u);
  EXPECT_EQ(record->loop_closure_count, 0);
  EXPECT_EQ(record->rejected_candidate_count, 0);
}

TEST_P(StorageContract, RefusesIdThatIsTaken) {
  ASSERT_THAT(write().Create("truck", "first"), IsOk());
  EXPECT_THAT(write().Create("truck", "second"),
              IsError(StatusCode::kAlreadyExists, "VEHICLE_EXISTS", _));
  EXPECT_EQ(storage().GetVehicle("truck")->payload, "first");
}

TEST_P(StorageContract, SaysWhichVehicleIsUnknown) {
  EXPECT_THAT(storage().GetVehicle("truck"),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
}

TEST_P(StorageContract, AnswersNotFoundForKeyOfNoVehicle) {
  const auto not_found = IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _);
  EXPECT_THAT(write().Update(5, "x", 2), not_found);
  EXPECT_THAT(write().Delete(5), not_found);
  EXPECT_THAT(write().Append(5, Batch(1, 1, 2, "x")), not_found);
  EXPECT_THAT(write().Revise(5, {}, 2), not_found);
  EXPECT_THAT(ReadAll(storage(), 5, 1, 1), not_found);
  for (const PairKind kind : kPairKinds) {
    EXPECT_THAT(write().AddPair(5, kind, {"a", 2, 1, 0}, 2), not_found);
    EXPECT_THAT(write().DeletePair(5, kind, "a", 2), not_found);
    EXPECT_THAT(storage().ListPosePairs(5, kind, "", 10), not_found);
  }
  EXPECT_THAT(storage().ListDeletedPairs(5), not_found);
  EXPECT_THAT(write().PutChecks(5, {}), not_found);
  EXPECT_THAT(storage().ListChecks(5, 1, 9, false, 10), not_found);
}

TEST_P(StorageContract, ListsVehiclesByIdInPages) {
  for (const char* id : {"c", "a", "b10", "b", "b-1"}) {
    ASSERT_THAT(write().Create(id), IsOk());
  }
  const auto ids = [&](const std::string& after, int limit,
                       const std::string& prefix = "") {
    std::vector<std::string> result;
    const auto records = storage().ListVehicles(after, prefix, limit);
    EXPECT_THAT(records, IsOk());
    for (const VehicleRecord& record : *records) result.push_back(record.id);
    return result;
  };
  EXPECT_THAT(ids("", 10), ElementsAre("a", "b", "b-1", "b10", "c"));
  EXPECT_THAT(ids("", 2), ElementsAre("a", "b"));
  EXPECT_THAT(ids("b", 2), ElementsAre("b-1", "b10"));
  EXPECT_THAT(ids("bb", 2), ElementsAre("c"));
  EXPECT_THAT(ids("c", 2), IsEmpty());
  EXPECT_THAT(ids("", 10, "b"), ElementsAre("b", "b-1", "b10"));
  EXPECT_THAT(ids("b", 10, "b"), ElementsAre("b-1", "b10"));
  EXPECT_THAT(ids("", 10, "b1"), ElementsAre("b10"));
  EXPECT_THAT(ids("", 10, "b-"), ElementsAre("b-1"));
  EXPECT_THAT(ids("c", 10, "b"), IsEmpty());
  EXPECT_THAT(ids("", 10, "bb"), IsEmpty());
}

TEST_P(StorageContract, ReadsManyVehiclesAsItReadsEach) {
  std::map<std::string, VehicleKey> keys;
  for (const char* id : {"c", "a", "b10", "b", "B", "none of them"}) {
    keys[id] = *write().Create(id, std::string("payload of ") + id);
  }
  ASSERT_THAT(write().Append(keys["a"], Batch(1, 3, 2, "x")), IsOk());
  ASSERT_THAT(write().Append(keys["b"], Batch(1, 2, 2, "y")), IsOk());
  ASSERT_THAT(write().Append(keys["b"], Batch(3, 2, 5, "z")), IsOk());
  ASSERT_THAT(write().PutChecks(keys["b"], Step({}, 2, {}, {})), IsOk());
  for (const PairKind kind : kPairKinds) {
    ASSERT_THAT(write().AddPair(keys["b"], kind, {"pair", 2, 1, 0}, 7), IsOk());
  }
  ASSERT_THAT(write().Delete(keys["b10"]), IsOk());
  store_->Reopen();
  const auto records =
      storage().GetVehicles({"c", "nobody", "b", "a", "b10", "B", "b1"});
  ASSERT_THAT(records, IsOk());
  std::vector<std::string> alone;
  for (const char* id : {"B", "a", "b", "c"}) {
    alone.push_back(ToText(*storage().GetVehicle(id)));
  }
  EXPECT_EQ(ToTexts(*records), alone);
  EXPECT_EQ((*records)[2].checks, (ChecksHead{true, 2, 0}));
  for (const VehicleRecord& record : *records) {
    EXPECT_THAT(record.damage, IsOk());
  }
}

TEST_P(StorageContract, ReadsAnyNumberOfVehicles) {
  EXPECT_THAT(*storage().GetVehicles({}), IsEmpty());
  std::set<std::string> ids;
  for (int i = 1000; i < 3500; ++i) ids.insert("v" + std::to_string(i));
  EXPECT_THAT(*storage().GetVehicles(ids), IsEmpty());
  const std::vector<std::string> there = {"v1000", "v1999", "v2000",
                                          "v2999", "v3000", "v3499"};
  for (const std::string& id : there) ASSERT_THAT(write().Create(id), IsOk());
  const auto records = storage().GetVehicles(ids);
  ASSERT_THAT(records, IsOk());
  std::vector<std::string> found;
  for (const VehicleRecord& record : *records) found.push_back(record.id);
  EXPECT_EQ(found, there);
}

TEST_P(StorageContract, ListsRowsOfVehiclesByKeyInPages) {
  std::vector<VehicleKey> keys;
  for (const char* id : {"c", "a", "b"}) {
    keys.push_back(*write().Create(id, std::string("payload of ") + id));
    ASSERT_THAT(write().Append(keys.back(), Batch(1, 1, 2, "x")), IsOk());
  }
  const auto rows = [&](VehicleKey after, int limit) {
    std::string shown;
    const auto records = storage().ListVehicleRows(after, limit);
    EXPECT_THAT(records, IsOk());
    for (const VehicleRecord& record : *records) {
      EXPECT_THAT(record.damage, IsOk());
      EXPECT_EQ(storage().GetVehicle(record.id)->key, record.key);
      shown += record.id + ": " + record.payload + "; ";
    }
    return shown;
  };
  EXPECT_EQ(rows(0, 10), "c: payload of c; a: payload of a; b: payload of b; ");
  EXPECT_EQ(rows(0, 2), "c: payload of c; a: payload of a; ");
  EXPECT_EQ(rows(keys[1], 2), "b: payload of b; ");
  EXPECT_EQ(rows(keys[2], 2), "");
  ASSERT_THAT(write().Delete(keys[1]), IsOk());
  EXPECT_EQ(rows(keys[0], 2), "b: payload of b; ");
}

TEST_P(StorageContract, ReplacesPayloadAndRaisesRevision) {
  const VehicleKey key = *write().Create("truck", "first", 3);
  ASSERT_THAT(write().Update(key, "second", 5), IsOk());
  EXPECT_EQ(storage().GetVehicle("truck")->payload, "second");
  EXPECT_EQ(storage().GetVehicle("truck")->revision, 5u);
  ASSERT_THAT(write().Update(key, "third", 4), IsOk());
  EXPECT_EQ(storage().GetVehicle("truck")->payload, "third");
  EXPECT_EQ(storage().GetVehicle("truck")->revision, 5u);
}

TEST_P(StorageContract, AppendsOnlyWithoutGap) {
  const VehicleKey key = *write().Create("truck");
  const auto gap = [](const absl::Status& status) {
    EXPECT_THAT(status,
                IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _));
    return MetadataOf(status, "expected_sequence");
  };
  EXPECT_EQ(gap(write().Append(key, Batch(2, 1, 2, "x"))), "1");
  ASSERT_THAT(write().Append(key, Batch(1, 3, 2, "one")), IsOk());
  EXPECT_EQ(gap(write().Append(key, Batch(1, 3, 3, "one"))), "4");
  EXPECT_EQ(gap(write().Append(key, Batch(3, 3, 3, "x"))), "4");
  EXPECT_EQ(gap(write().Append(key, Batch(5, 3, 3, "x"))), "4");
  ASSERT_THAT(write().Append(key, Batch(4, 1, 3, "two")), IsOk());
  store_->Reopen();
  EXPECT_EQ(ToText(*storage().GetVehicle("truck")),
            "truck " + std::to_string(key) +
                ": 0 closures, 0 rejected, to 4, revision 3, 'payload'");
  EXPECT_THAT(ToTexts(*ReadAll(storage(), key, 1, 4)),
              ElementsAre("1+3, revision 2, 'one'", "4+1, revision 3, 'two'"));
}

TEST_P(StorageContract, AppendsSeveralBatchesInOneStepOrNone) {
  const VehicleKey key = *write().Create("truck", "old");
  const auto gap = IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _);
  const std::vector<BatchRecord> first = {
      Batch(1, 2, 2, "a"), Batch(3, 1, 3, "b"), Batch(4, 5, 4, "c")};
  EXPECT_THAT(write().AppendAll(key, {first[1], first[2]}), gap);
  EXPECT_THAT(write().AppendAll(key, {first[1], first[2]}, "new"), gap);
  EXPECT_EQ(storage().GetVehicle("truck")->durable_sequence, 0u);
  ASSERT_THAT(write().AppendAll(key, first, "new"), IsOk());
  EXPECT_THAT(write().AppendAll(key, first), gap);
  ASSERT_THAT(
      write().AppendAll(key, {Batch(9, 1, 5, "d"), Batch(10, 3, 6, "e")}),
      IsOk());
  // Many at a time, some of which have to wait for others.
  std::vector<Answer<absl::Status>> answers(50);
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    storage().AppendBatches(
        key,
        {Batch(13 + 2 * i, 1, 7 + i, "f"), Batch(14 + 2 * i, 1, 8 + i, "g")},
        std::nullopt, answers[i].Setter());
  }
  for (const auto& answer : answers) EXPECT_THAT(answer.Get(), IsOk());
  store_->Reopen();
  EXPECT_EQ(ToText(*storage().GetVehicle("truck")),
            "truck " + std::to_string(key) +
                ": 0 closures, 0 rejected, to 112, revision 57, 'new'");
  EXPECT_THAT(ToTexts(*ReadAll(storage(), key, 1, 12)),
              ElementsAre("1+2, revision 2, 'a'", "3+1, revision 3, 'b'",
                          "4+5, revision 4, 'c'", "9+1, revision 5, 'd'",
                          "10+3, revision 6, 'e'"));
  EXPECT_THAT(
      ToTexts(*ReadAll(storage(), key, 111, 112)),
      ElementsAre("111+1, revision 56, 'f'", "112+1, revision 57, 'g'"));
}

TEST_P(StorageContract, ReplacesVehiclePayloadWithBatchOrNotAtAll) {
  const VehicleKey key = *write().Create("truck", "old");
  EXPECT_THAT(write().AppendWithVehicle(key, Batch(2, 1, 2, "x"), "new"),
              IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _));
  EXPECT_EQ(storage().GetVehicle("truck")->payload, "old");
  ASSERT_THAT(write().AppendWithVehicle(key, Batch(1, 1, 2, "x"), "new"),
              IsOk());
  EXPECT_EQ(storage().GetVehicle("truck")->payload, "new");
}

TEST_P(StorageContract, ReadsBatchesThatHoldTheRange) {
  const VehicleKey key = *write().Create("truck");
  const VehicleKey other = *write().Create("other");
  for (std::uint64_t first = 1; first <= 13; first += 3) {
    const auto revision = first + 1;
    ASSERT_THAT(write().Append(key, Batch(first, 3, revision, "mine")), IsOk());
    ASSERT_THAT(write().Append(other, Batch(first, 3, revision, "theirs")),
                IsOk());
  }
  const auto firsts = [&](std::uint64_t first, std::uint64_t last) {
    std::vector<std::uint64_t> result;
    const auto batches = ReadAll(storage(), key, first, last);
    EXPECT_THAT(batches, IsOk());
    for (const BatchRecord& batch : *batches) {
      EXPECT_EQ(batch.payload, "mine");
      result.push_back(batch.first_sequence);
    }
    return result;
  };
  EXPECT_THAT(firsts(1, 15), ElementsAre(1, 4, 7, 10, 13));
  EXPECT_THAT(firsts(4, 4), ElementsAre(4));
  EXPECT_THAT(firsts(6, 7), ElementsAre(4, 7));
  EXPECT_THAT(firsts(15, 15), ElementsAre(13));
  EXPECT_THAT(firsts(9, 8), IsEmpty());
}

TEST_P(StorageContract, StopsReadingWhenTold) {
  const VehicleKey key = *write().Create("truck");
  ASSERT_THAT(write().Append(key, Batch(1, 2, 2, "a")), IsOk());
  ASSERT_THAT(write().Append(key, Batch(3, 2, 3, "b")), IsOk());
  std::vector<std::string> visited;
  EXPECT_THAT(storage().ReadBatches(key, 1, 4, BatchVersion::kAsSent,
                                    [&](const BatchRecord& batch) {
                                      visited.push_back(batch.payload);
                                      return false;
                                    }),
              IsOk());
  EXPECT_THAT(visited, ElementsAre("a"));
}

TEST_P(StorageContract, CallsPosesThatAreNotThereLost) {
  const VehicleKey key = *write().Create("truck");
  const auto lost = IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _);
  EXPECT_THAT(ReadAll(storage(), key, 1, 1), lost);
  ASSERT_THAT(write().Append(key, Batch(1, 2, 2, "a")), IsOk());
  EXPECT_THAT(ReadAll(storage(), key, 1, 3), lost);
  EXPECT_THAT(ReadAll(storage(), key, 3, 3), lost);
  EXPECT_THAT(ReadAll(storage(), key, 3, 1000), lost);
  EXPECT_THAT(ReadAll(storage(), key, 1, 2), IsOk());
}

TEST_P(StorageContract, KeepsWhatWasSentBesideItsRevision) {
  const VehicleKey key = *write().Create("truck");
  ASSERT_THAT(write().Append(key, Batch(1, 2, 2, "a")), IsOk());
  ASSERT_THAT(write().Append(key, Batch(3, 2, 3, "b")), IsOk());
  ASSERT_THAT(write().Append(key, Batch(5, 2, 4, "c")), IsOk());
  ASSERT_THAT(
      write().Revise(key, {Batch(1, 2, 0, "A"), Batch(5, 2, 0, "C")}, 6),
      IsOk());
  ASSERT_THAT(write().Revise(key, {Batch(5, 2, 0, "CC")}, 7), IsOk());
  store_->Reopen();
  EXPECT_EQ(storage().GetVehicle("truck")->revision, 7u);
  EXPECT_THAT(ToTexts(*ReadAll(storage(), key, 1, 6, BatchVersion::kCurrent)),
              ElementsAre("1+2, revision 6, 'A'", "3+2, revision 3, 'b'",
                          "5+2, revision 7, 'CC'"));
  EXPECT_THAT(ToTexts(*ReadAll(storage(), key, 1, 6, BatchVersion::kAsSent)),
              ElementsAre("1+2, revision 2, 'a'", "3+2, revision 3, 'b'",
                          "5+2, revision 4, 'c'"));
}

TEST_P(StorageContract, RevisesAllOrNothing) {
  const VehicleKey key = *write().Create("truck");
  ASSERT_THAT(write().Append(key, Batch(1, 2, 2, "a")), IsOk());
  for (const BatchRecord& wrong :
       {Batch(3, 2, 0, "x"), Batch(2, 1, 0, "x"), Batch(1, 1, 0, "x")}) {
    EXPECT_THAT(write().Revise(key, {Batch(1, 2, 0, "A"), wrong}, 3),
                IsError(StatusCode::kFailedPrecondition, _, _))
        << ToText(wrong);
  }
  EXPECT_THAT(ToTexts(*ReadAll(storage(), key, 1, 2)),
              ElementsAre("1+2, revision 2, 'a'"));
  EXPECT_EQ(storage().GetVehicle("truck")->revision, 2u);
}

TEST_P(StorageContract, ReplacesBatchesWithTheirRevisions) {
  const VehicleKey key = *write().Create("truck");
  const VehicleKey other = *write().Create("tram");
  for (std::uint64_t i = 0; i < 5; ++i) {
    ASSERT_THAT(write().Append(key, Batch(2 * i + 1, 2, i + 2, "sent")),
                IsOk());
    ASSERT_THAT(write().Append(other, Batch(2 * i + 1, 2, i + 2, "other")),
                IsOk());
  }
  ASSERT_THAT(
      write().Revise(key, {Batch(3, 2, 0, "B"), Batch(9, 2, 0, "E")}, 7),
      IsOk());
  // Two become one, and another one two.
  ASSERT_THAT(write().Replace(key,
                              {{Batch(3, 4, 8, "merged")},
                               {Batch(7, 1, 5, "s"), Batch(7, 1, 6, "S")},
                               {Batch(8, 1, 5, "ent")}},
                              8),
              IsOk());
  store_->Reopen();
  EXPECT_EQ(storage().GetVehicle("truck")->revision, 8u);
  EXPECT_THAT(ToTexts(*ReadAll(storage(), key, 1, 10, BatchVersion::kCurrent)),
              ElementsAre("1+2, revision 2, 'sent'",
                          "3+4, revision 8, 'merged'", "7+1, revision 6, 'S'",
                          "8+1, revision 5, 'ent'", "9+2, revision 7, 'E'"));
  EXPECT_THAT(ToTexts(*ReadAll(storage(), key, 4, 7, BatchVersion::kAsSent)),
              ElementsAre("3+4, revision 8, 'merged'", "7+1, revision 5, 's'"));
  // What was replaced can be replaced again, with all that the vehicle has.
  ASSERT_THAT(write().Replace(key, {{Batch(1, 10, 9, "all")}}, 9), IsOk());
  EXPECT_THAT(ToTexts(*ReadAll(storage(), key, 1, 10)),
              ElementsAre("1+10, revision 9, 'all'"));
  EXPECT_THAT(write().Append(key, Batch(11, 1, 10, "next")), IsOk());
  EXPECT_EQ(ReadAll(storage(), other, 1, 10)->size(), 5u);
}

TEST_P(StorageContract, ReplacesWholeBatchesOrNothing) {
  const VehicleKey key = *write().Create("truck");
  ASSERT_THAT(write().Append(key, Batch(1, 3, 2, "a")), IsOk());
  ASSERT_THAT(write().Append(key, Batch(4, 3, 3, "b")), IsOk());
  for (const BatchRecord& wrong :
       {Batch(1, 2, 4, "x"), Batch(2, 2, 4, "x"), Batch(1, 4, 4, "x"),
        Batch(2, 5, 4, "x"), Batch(4, 4, 4, "x"), Batch(7, 1, 4, "x")}) {
    EXPECT_THAT(write().Replace(key, {{wrong}}, 4),
                IsError(StatusCode::kFailedPrecondition, "INTERNAL", _))
        << ToText(wrong);
  }
  EXPECT_THAT(ToTexts(*ReadAll(storage(), key, 1, 6)),
              ElementsAre("1+3, revision 2, 'a'", "4+3, revision 3, 'b'"));
  EXPECT_EQ(storage().GetVehicle("truck")->revision, 3u);
  EXPECT_THAT(write().Replace(99, {{Batch(1, 3, 4, "x")}}, 4),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
}

TEST_P(StorageContract, KeepsPairsOfPoses) {
  for (const PairKind kind : kPairKinds) {
    const PairWords words = WordsOf(kind);
    SCOPED_TRACE(words.noun);
    const std::string id = "truck-" + std::to_string(static_cast<int>(kind));
    const VehicleKey key = *write().Create(id);
    const VehicleKey other = *write().Create("other-" + id);
    const auto add = [&](const PosePairRecord& pair, std::uint64_t revision) {
      return write().AddPair(key, kind, pair, revision);
    };
    const auto list = [&](const std::string& after, int limit) {
      return ToTexts(*storage().ListPosePairs(key, kind, after, limit));
    };
    ASSERT_THAT(add({"b", 9, 2, -5}, 2), IsOk());
    ASSERT_THAT(add({"a", 8, 1, 1234567890123456789}, 3), IsOk());
    ASSERT_THAT(add({"c", 7, 3, 0}, 4), IsOk());
    ASSERT_THAT(write().AddPair(other, kind, {"a", 3, 2, 0}, 2), IsOk());
    EXPECT_THAT(add({"a", 8, 1, 0}, 9),
                IsError(StatusCode::kAlreadyExists, words.exists, _));
    EXPECT_EQ(storage().GetVehicle(id)->revision, 4u);
    ASSERT_THAT(write().DeletePair(key, kind, "c", 5), IsOk());
    EXPECT_THAT(write().DeletePair(key, kind, "c", 6),
                IsError(StatusCode::kNotFound, words.not_found, _));
    store_->Reopen();
    EXPECT_EQ(storage().GetVehicle(id)->revision, 5u);
    EXPECT_THAT(list("", 10), ElementsAre("a: 8 at 1, 1234567890123456789 ns",
                                          "b: 9 at 2, -5 ns"));
    EXPECT_THAT(list("", 1), ElementsAre("a: 8 at 1, 1234567890123456789 ns"));
    EXPECT_THAT(list("a", 10), ElementsAre("b: 9 at 2, -5 ns"));
  }
}

TEST_P(StorageContract, KeepsKindsOfPairsApart) {
  const VehicleKey key = *write().Create("truck");
  ASSERT_THAT(write().AddPair(key, PairKind::kLoopClosure, {"a", 9, 2, 1}, 2),
              IsOk());
  EXPECT_THAT(
      write().DeletePair(key, PairKind::kRejectedCandidate, "a", 3),
      IsError(StatusCode::kNotFound, "REJECTED_CANDIDATE_NOT_FOUND", _));
  ASSERT_THAT(
      write().AddPair(key, PairKind::kRejectedCandidate, {"a", 8, 3, 2}, 3),
      IsOk());
  ASSERT_THAT(write().AddPair(key, PairKind::kRejectedCandidate,
                              {"b", 7, 3, 3, "why"}, 4),
              IsOk());
  EXPECT_EQ(ToText(*storage().GetVehicle("truck")),
            "truck " + std::to_string(key) +
                ": 1 closures, 2 rejected, to 0, revision 4, 'payload'");
  ASSERT_THAT(write().DeletePair(key, PairKind::kLoopClosure, "a", 5), IsOk());
  EXPECT_THAT(*storage().ListPosePairs(key, PairKind::kLoopClosure, "", 10),
              IsEmpty());
  EXPECT_THAT(ToTexts(*storage().ListPosePairs(
                  key, PairKind::kRejectedCandidate, "", 10)),
              ElementsAre("a: 8 at 3, 2 ns", "b: 7 at 3, 3 ns, 'why'"));
}

TEST_P(StorageContract, KeepsDeletedPairsAsLongAsTheirVehicle) {
  const VehicleKey key = *write().Create("truck");
  const VehicleKey other = *write().Create("other");
  ASSERT_THAT(write().Append(key, Batch(1, 2, 2, "a")), IsOk());
  const auto remove = [&](VehicleKey from, PairKind kind, const char* id,
                          std::int64_t time_ns, std::uint64_t revision) {
    DeletedPairRecord deleted;
    deleted.number = 77;  // Not read.
    deleted.kind = kind;
    deleted.pair = {id, 2, 1, -5, "said"};
    deleted.delete_time_ns = time_ns;
    return write().DeletePair(from, deleted, revision);
  };
  for (const PairKind kind : kPairKinds) {
    ASSERT_THAT(write().AddPair(key, kind, {"a", 2, 1, -5, "said"}, 3), IsOk());
    ASSERT_THAT(write().AddPair(other, kind, {"a", 2, 1, -5}, 3), IsOk());
  }
  ASSERT_THAT(remove(key, PairKind::kRejectedCandidate, "a", 8, 4), IsOk());
  EXPECT_THAT(
      remove(key, PairKind::kRejectedCandidate, "a", 9, 5),
      IsError(StatusCode::kNotFound, "REJECTED_CANDIDATE_NOT_FOUND", _));
  ASSERT_THAT(remove(key, PairKind::kLoopClosure, "a", 7, 6), IsOk());
  ASSERT_THAT(remove(other, PairKind::kLoopClosure, "a", 9, 4), IsOk());
  const std::vector<std::string> expected = {
      "2, closure a: 2 at 1, -5 ns, 'said', deleted at 7 ns",
      "1, rejected a: 2 at 1, -5 ns, 'said', deleted at 8 ns"};
  EXPECT_EQ(ToTexts(*storage().ListDeletedPairs(key)), expected);
  ASSERT_THAT(write().Revise(key, {Batch(1, 2, 0, "A")}, 7), IsOk());
  ASSERT_THAT(write().Replace(key, {{Batch(1, 2, 8, "dropped")}}, 8), IsOk());
  ASSERT_THAT(write().DropDamaged(key, 0, "none", 9), IsOk());
  store_->Reopen();
  EXPECT_EQ(ToTexts(*storage().ListDeletedPairs(key)), expected);
  ASSERT_THAT(write().Delete(key), IsOk());
  EXPECT_THAT(storage().ListDeletedPairs(key),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
  EXPECT_THAT(*storage().ListDeletedPairs(*write().Create("truck")), IsEmpty());
  EXPECT_THAT(
      ToTexts(*storage().ListDeletedPairs(other)),
      ElementsAre("1, closure a: 2 at 1, -5 ns, 'said', deleted at 9 ns"));
}

TEST_P(StorageContract, KeepsTheLast1000DeletedPairs) {
  const VehicleKey key = *write().Create("truck");
  const Answer<absl::Status> last;
  for (std::uint64_t i = 1; i <= kMostDeletedPairs + 2; ++i) {
    const PairKind kind = kPairKinds[i % 2];
    DeletedPairRecord deleted;
    deleted.kind = kind;
    deleted.pair = {"p", i + 1, 1, 0};
    storage().AddPosePair(key, kind, deleted.pair, std::nullopt, 2 * i,
                          [](const absl::Status&) {});
    storage().DeletePosePair(
        key, deleted, std::nullopt, 2 * i + 1,
        i == kMostDeletedPairs + 2 ? last.Setter()
                                   : [](const absl::Status&) {});
  }
  ASSERT_THAT(last.Get(), IsOk());
  const auto kept = storage().ListDeletedPairs(key);
  ASSERT_THAT(kept, IsOk());
  ASSERT_EQ(kept->size(), static_cast<std::size_t>(kMostDeletedPairs));
  EXPECT_EQ(kept->front().number, kMostDeletedPairs + 2u);
  EXPECT_EQ(kept->front().pair.query_sequence, kMostDeletedPairs + 3u);
  EXPECT_EQ(kept->back().number, 3u);
  EXPECT_EQ(kept->back().pair.query_sequence, 4u);
}

TEST_P(StorageContract, GivesUpWhatComesAfterASequence) {
  const VehicleKey key = *write().Create("truck");
  for (std::uint64_t i = 0; i < 3; ++i) {
    ASSERT_THAT(write().Append(key, Batch(2 * i + 1, 2, i + 2, "a")), IsOk());
  }
  ASSERT_THAT(
      write().Revise(key, {Batch(1, 2, 0, "A"), Batch(5, 2, 0, "B")}, 5),
      IsOk());
  for (const PairKind kind : kPairKinds) {
    ASSERT_THAT(write().AddPair(key, kind, {"a", 4, 1, 0}, 6), IsOk());
    ASSERT_THAT(write().AddPair(key, kind, {"b", 5, 1, 0}, 7), IsOk());
  }
  EXPECT_THAT(write().DropDamaged(key, 3, "new", 8),
              IsError(StatusCode::kFailedPrecondition, "INTERNAL", _));
  ASSERT_THAT(write().DropDamaged(key, 4, "new", 9), IsOk());
  store_->Reopen();
  EXPECT_EQ(ToText(*storage().GetVehicle("truck")),
            "truck " + std::to_string(key) +
                ": 1 closures, 1 rejected, to 4, revision 9, 'new'");
  EXPECT_THAT(ToTexts(*ReadAll(storage(), key, 1, 4)),
              ElementsAre("1+2, revision 5, 'A'", "3+2, revision 3, 'a'"));
  EXPECT_THAT(write().Append(key, Batch(5, 1, 10, "c")), IsOk());
  EXPECT_THAT(ToTexts(*ReadAll(storage(), key, 5, 5)),
              ElementsAre("5+1, revision 10, 'c'"));
  ASSERT_THAT(write().DropDamaged(key, 0, "none", 11), IsOk());
  EXPECT_EQ(ToText(*storage().GetVehicle("truck")),
            "truck " + std::to_string(key) +
                ": 0 closures, 0 rejected, to 0, revision 11, 'none'");
  EXPECT_THAT(write().DropDamaged(99, 0, "none", 12),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
}

TEST_P(StorageContract, DeletesVehicleWithAllThatBelongsToIt) {
  const VehicleKey key = *write().Create("truck");
  for (std::uint64_t i = 0; i < 100; ++i) {
    ASSERT_THAT(write().Append(key, Batch(2 * i + 1, 2, i + 2, "a")), IsOk());
  }
  ASSERT_THAT(write().Revise(key, {Batch(1, 2, 0, "A")}, 200), IsOk());
  for (const PairKind kind : kPairKinds) {
    ASSERT_THAT(write().AddPair(key, kind, {"a", 2, 1, 0}, 201), IsOk());
  }
  ASSERT_THAT(write().Delete(key), IsOk());
  const auto not_found = IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _);
  EXPECT_THAT(storage().GetVehicle("truck"), not_found);
  EXPECT_THAT(ReadAll(storage(), key, 1, 2), not_found);
  EXPECT_THAT(write().Append(key, Batch(201, 1, 202, "b")), not_found);
  EXPECT_THAT(write().Delete(key), not_found);
  store_->Reopen();
  const absl::StatusOr<VehicleKey> again = write().Create("truck", "new");
  ASSERT_THAT(again, IsOk());
  EXPECT_NE(*again, key);
  EXPECT_EQ(ToText(*storage().GetVehicle("truck")),
            "truck " + std::to_string(*again) +
                ": 0 closures, 0 rejected, to 0, revision 1, 'new'");
  for (const PairKind kind : kPairKinds) {
    EXPECT_THAT(*storage().ListPosePairs(*again, kind, "", 10), IsEmpty());
  }
}

TEST_P(StorageContract, NeverUsesKeyAgain) {
  const VehicleKey first = *write().Create("a");
  ASSERT_THAT(write().Delete(first), IsOk());
  store_->Reopen();
  const VehicleKey second = *write().Create("a");
  EXPECT_GT(second, first);
}

TEST_P(StorageContract, RefusedWriteLeavesThoseAroundItAlone) {
  const VehicleKey key = *write().Create("truck");
  std::vector<Answer<absl::Status>> answers(4);
  AppendBatch(storage(), key, Batch(1, 1, 2, "a"), "one", answers[0].Setter());
  AppendBatch(storage(), key, Batch(1, 1, 2, "b"), "two", answers[1].Setter());
  AppendBatch(storage(), key, Batch(3, 1, 2, "c"), "three",
              answers[2].Setter());
  AppendBatch(storage(), key, Batch(2, 1, 3, "d"), std::nullopt,
              answers[3].Setter());
  EXPECT_THAT(answers[0].Get(), IsOk());
  EXPECT_THAT(answers[1].Get(),
              IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _));
  EXPECT_THAT(answers[2].Get(),
              IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _));
  EXPECT_THAT(answers[3].Get(), IsOk());
  EXPECT_THAT(ToTexts(*ReadAll(storage(), key, 1, 2)),
              ElementsAre("1+1, revision 2, 'a'", "2+1, revision 3, 'd'"));
  EXPECT_EQ(storage().GetVehicle("truck")->payload, "one");
}

TEST_P(StorageContract, CommitsWhatWasSubmittedBeforeItCloses) {
  const VehicleKey key = *write().Create("truck");
  std::atomic<int> done{0};
  for (std::uint64_t i = 1; i <= 300; ++i) {
    AppendBatch(storage(), key, Batch(i, 1, i + 1, "a"), std::nullopt,
                [&](const absl::Status& status) {
                  EXPECT_THAT(status, IsOk());
                  ++done;
                });
  }
  store_->Reopen();
  EXPECT_EQ(done, 300);
  EXPECT_EQ(storage().GetVehicle("truck")->durable_sequence, 300u);
}

TEST_P(StorageContract, AnswersWritesInTheOrderTheyCame) {
  constexpr int kThreads = 4;
  constexpr std::uint64_t kBatches = 200;
  std::vector<VehicleKey> keys;
  for (int t = 0; t < kThreads; ++t) {
    keys.push_back(*write().Create("vehicle-" + std::to_string(t)));
  }
  std::mutex mutex;
  std::vector<std::vector<std::uint64_t>> answered(kThreads);
  std::vector<std::thread> threads;
  for (int t = 0; t < kThreads; ++t) {
    threads.emplace_back([&, t] {
      const auto index = static_cast<std::size_t>(t);
      for (std::uint64_t i = 1; i <= kBatches; ++i) {
        AppendBatch(storage(), keys[index], Batch(i, 1, i + 1, "a"),
                    std::nullopt, [&, index, i](absl::Status status) {
                      EXPECT_THAT(status, IsOk());
                      const std::lock_guard<std::mutex> g(mutex);
                      answered[index].push_back(i);
                    });
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  store_->Reopen();
  for (int t = 0; t < kThreads; ++t) {
    const auto index = static_cast<std::size_t>(t);
    const std::vector<std::uint64_t>& order = answered[index];
    EXPECT_TRUE(std::is_sorted(order.begin(), order.end()));
    EXPECT_EQ(order.size(), kBatches);
    EXPECT_EQ(
        storage().GetVehicle("vehicle-" + std::to_string(t))->durable_sequence,
        kBatches);
  }
}

TEST_P(StorageContract, ReadsOneMomentEvenWhileWritesGoOn) {
  const VehicleKey key = *write().Create("truck");
  for (std::uint64_t i = 1; i <= 3; ++i) {
    ASSERT_THAT(write().Append(key, Batch(i, 1, i + 1, "old")), IsOk());
  }
  std::vector<std::string> visited;
  EXPECT_THAT(storage().ReadBatches(
                  key, 1, 3, BatchVersion::kCurrent,
                  [&](const BatchRecord& batch) {
                    if (visited.empty()) {
                      EXPECT_THAT(
                          write().Revise(key, {Batch(3, 1, 0, "new")}, 9),
                          IsOk());
                      EXPECT_EQ(storage().GetVehicle("truck")->revision, 9u);
                    }
                    visited.push_back(batch.payload);
                    return true;
                  }),
              IsOk());
  EXPECT_THAT(visited, ElementsAre("old", "old", "old"));
}

TEST_P(StorageContract, ReadersSeeEveryWriteThatWasAnswered) {
  const VehicleKey key = *write().Create("truck");
  std::atomic<std::uint64_t> acknowledged{0};
  std::thread reader([&] {
    while (acknowledged < 200) {
      const std::uint64_t before = acknowledged;
      const absl::StatusOr<VehicleRecord> record =
          storage().GetVehicle("truck");
      ASSERT_THAT(record, IsOk());
      EXPECT_GE(record->durable_sequence, before);
    }
  });
  for (std::uint64_t i = 1; i <= 200; ++i) {
    EXPECT_THAT(write().Append(key, Batch(i, 1, i + 1, "a")), IsOk());
    acknowledged = i;
  }
  reader.join();
}

TEST_P(StorageContract, KeepsASnapshotInPartsUntilPosesAreRevised) {
  if (!storage().KeepsSnapshots()) GTEST_SKIP() << "it keeps none";
  const VehicleKey key = *write().Create("truck");
  const VehicleKey other = *write().Create("other");
  for (const VehicleKey k : {key, other}) {
    ASSERT_THAT(write().Append(k, Batch(1, 7, 2, "seven")), IsOk());
  }
  EXPECT_EQ(SnapshotOf(storage(), key), "none");
  EXPECT_THAT(write().PutSnapshotPart(key, 1, "b"),
              IsError(StatusCode::kFailedPrecondition, _, _));
  ASSERT_THAT(write().PutSnapshotPart(key, 0, "a"), IsOk());
  ASSERT_THAT(write().PutSnapshotPart(key, 1, "b"), IsOk());
  EXPECT_THAT(write().PutSnapshotPart(key, 3, "d"),
              IsError(StatusCode::kFailedPrecondition, _, _));
  // Parts alone are none.
  EXPECT_EQ(SnapshotOf(storage(), key), "none");
  EXPECT_THAT(write().PutSnapshot(key, {5, 3, "x"}),
              IsError(StatusCode::kFailedPrecondition, _, _));
  ASSERT_THAT(write().PutSnapshot(key, {5, 2, "x"}), IsOk());
  ASSERT_THAT(write().PutSnapshotPart(other, 0, "o"), IsOk());
  ASSERT_THAT(write().PutSnapshot(other, {7, 1, "y"}), IsOk());
  // A part more, and one that is written again.
  ASSERT_THAT(write().PutSnapshotPart(key, 2, "c"), IsOk());
  ASSERT_THAT(write().PutSnapshotPart(key, 1, "b"), IsOk());
  store_->Reopen();
  EXPECT_EQ(SnapshotOf(storage(), key), "to 5: a b, 'x'");
  ASSERT_THAT(write().PutSnapshot(key, {6, 3, "z"}), IsOk());
  EXPECT_EQ(SnapshotOf(storage(), key), "to 6: a b c, 'z'");
  // Reading may begin at any part, and end.
  std::string read;
  EXPECT_THAT(storage().ReadSnapshotParts(key, 1, 3,
                                          [&](absl::string_view part) {
                                            read += std::string(part);
                                            return false;
                                          }),
              IsOk());
  EXPECT_EQ(read, "b");
  // Changes that move no poses leave it alone.
  ASSERT_THAT(write().Append(key, Batch(8, 1, 3, "eight")), IsOk());
  ASSERT_THAT(write().Update(key, "payload", 4), IsOk());
  ASSERT_THAT(write().AddPair(key, PairKind::kLoopClosure, {"l", 7, 1, 9}, 5),
              IsOk());
  EXPECT_EQ(SnapshotOf(storage(), key), "to 6: a b c, 'z'");
  // Refused, as it is not stored so: nothing changes.
  EXPECT_FALSE(write().Revise(key, {Batch(1, 3, 0, "three")}, 6).ok());
  EXPECT_EQ(SnapshotOf(storage(), key), "to 6: a b c, 'z'");
  ASSERT_THAT(write().Revise(key, {Batch(1, 7, 0, "SEVEN")}, 6), IsOk());
  EXPECT_EQ(SnapshotOf(storage(), key), "none");
  EXPECT_THAT(write().PutSnapshotPart(key, 3, "d"),
              IsError(StatusCode::kFailedPrecondition, _, _));
  EXPECT_THAT(write().PutSnapshot(key, {6, 3, "z"}),
              IsError(StatusCode::kFailedPrecondition, _, _));
  EXPECT_EQ(SnapshotOf(storage(), other), "to 7: o, 'y'");
}

TEST_P(StorageContract, RemovesASnapshotWithWhatItComesFrom) {
  if (!storage().KeepsSnapshots()) GTEST_SKIP() << "it keeps none";
  const VehicleKey key = *write().Create("truck");
  ASSERT_THAT(write().Append(key, Batch(1, 4, 2, "four")), IsOk());
  ASSERT_THAT(write().Append(key, Batch(5, 3, 3, "three")), IsOk());
  const auto put = [&](const std::string& part) {
    ASSERT_THAT(write().PutSnapshotPart(key, 0, part), IsOk());
    ASSERT_THAT(write().PutSnapshot(key, {7, 1, "x"}), IsOk());
    ASSERT_EQ(SnapshotOf(storage(), key), "to 7: " + part + ", 'x'");
  };
  put("a");
  ASSERT_THAT(write().DropDamaged(key, 4, "payload", 4), IsOk());
  EXPECT_EQ(SnapshotOf(storage(), key), "none");
  put("m");
  EXPECT_FALSE(write().Replace(key, {{Batch(1, 3, 5, "x")}}, 5).ok());
  EXPECT_EQ(SnapshotOf(storage(), key), "to 7: m, 'x'");
  ASSERT_THAT(write().Replace(key, {{Batch(1, 4, 5, "x")}}, 5), IsOk());
  EXPECT_EQ(SnapshotOf(storage(), key), "none");
  put("b");
  ASSERT_THAT(write().DropSnapshot(key), IsOk());
  EXPECT_EQ(SnapshotOf(storage(), key), "none");
  put("c");
  // The first part begins anew.
  ASSERT_THAT(write().PutSnapshotPart(key, 0, "d"), IsOk());
  EXPECT_EQ(SnapshotOf(storage(), key), "none");
  put("e");
  ASSERT_THAT(write().PutSnapshot(key, {3, 0, "short"}), IsOk());
  EXPECT_EQ(SnapshotOf(storage(), key), "to 3:, 'short'");
  ASSERT_THAT(write().Delete(key), IsOk());
  EXPECT_EQ(SnapshotOf(storage(), key), "none");
  for (const absl::Status& status :
       {write().PutSnapshotPart(key, 0, "f"), write().DropSnapshot(key),
        write().PutSnapshot(key, {3, 0, "short"})}) {
    EXPECT_THAT(status, IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
  }
}

TEST_P(StorageContract, KeepsMarksBesideASnapshotOrWithoutOne) {
  if (!storage().KeepsSnapshots()) GTEST_SKIP() << "it keeps none";
  const VehicleKey key = *write().Create("truck");
  const VehicleKey other = *write().Create("other");
  ASSERT_THAT(write().Append(key, Batch(1, 7, 2, "seven")), IsOk());
  EXPECT_EQ(MarksOf(storage(), key), "none");
  ASSERT_THAT(write().PutMarks(key, "first"), IsOk());
  ASSERT_THAT(write().PutMarks(key, "marks"), IsOk());
  ASSERT_THAT(write().PutMarks(other, ""), IsOk());
  store_->Reopen();
  EXPECT_EQ(MarksOf(storage(), key), "marks");
  EXPECT_EQ(MarksOf(storage(), other), "");
  // They are no snapshot, and no part of one.
  EXPECT_EQ(SnapshotOf(storage(), key), "none");
  EXPECT_THAT(write().PutSnapshotPart(key, 1, "b"),
              IsError(StatusCode::kFailedPrecondition, _, _));
  EXPECT_THAT(write().PutSnapshot(key, {5, 1, "x"}),
              IsError(StatusCode::kFailedPrecondition, _, _));
  ASSERT_THAT(write().PutSnapshot(key, {5, 0, "x"}), IsOk());
  EXPECT_EQ(MarksOf(storage(), key), "marks");
  EXPECT_EQ(SnapshotOf(storage(), key), "to 5:, 'x'");
  // The first part begins anew, those behind it do not.
  ASSERT_THAT(write().PutSnapshotPart(key, 0, "a"), IsOk());
  EXPECT_EQ(MarksOf(storage(), key), "none");
  ASSERT_THAT(write().PutMarks(key, "new"), IsOk());
  ASSERT_THAT(write().PutSnapshotPart(key, 1, "b"), IsOk());
  ASSERT_THAT(write().PutSnapshot(key, {7, 2, "y"}), IsOk());
  EXPECT_EQ(MarksOf(storage(), key), "new");
  EXPECT_EQ(SnapshotOf(storage(), key), "to 7: a b, 'y'");
  // Changes that move no poses leave them alone.
  ASSERT_THAT(write().Append(key, Batch(8, 1, 3, "eight")), IsOk());
  ASSERT_THAT(write().Update(key, "payload", 4), IsOk());
  EXPECT_EQ(MarksOf(storage(), key), "new");
}

TEST_P(StorageContract, RemovesMarksWithThePosesThatTheyWereFoundIn) {
  if (!storage().KeepsSnapshots()) GTEST_SKIP() << "it keeps none";
  const VehicleKey key = *write().Create("truck");
  ASSERT_THAT(write().Append(key, Batch(1, 4, 2, "four")), IsOk());
  ASSERT_THAT(write().Append(key, Batch(5, 3, 3, "three")), IsOk());
  const auto put = [&](const std::string& marks) {
    ASSERT_THAT(write().PutMarks(key, marks), IsOk());
    ASSERT_EQ(MarksOf(storage(), key), marks);
  };
  put("a");
  ASSERT_THAT(write().DropDamaged(key, 4, "payload", 4), IsOk());
  EXPECT_EQ(MarksOf(storage(), key), "none");
  put("b");
  EXPECT_FALSE(write().Replace(key, {{Batch(1, 3, 5, "x")}}, 5).ok());
  EXPECT_EQ(MarksOf(storage(), key), "b");
  ASSERT_THAT(write().Replace(key, {{Batch(1, 4, 5, "x")}}, 5), IsOk());
  EXPECT_EQ(MarksOf(storage(), key), "none");
  put("c");
  ASSERT_THAT(write().Revise(key, {Batch(1, 4, 0, "FOUR")}, 6), IsOk());
  EXPECT_EQ(MarksOf(storage(), key), "none");
  put("d");
  ASSERT_THAT(write().DropSnapshot(key), IsOk());
  EXPECT_EQ(MarksOf(storage(), key), "none");
  put("e");
  ASSERT_THAT(write().Delete(key), IsOk());
  EXPECT_EQ(MarksOf(storage(), key), "none");
  EXPECT_THAT(write().PutMarks(key, "f"),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
  EXPECT_EQ(MarksOf(storage(), *write().Create("truck")), "none");
}

TEST_P(StorageContract, KeepsChecksAndTheirEventsInOneStep) {
  const VehicleKey key = *write().Create("truck");
  ASSERT_THAT(write().Append(key, Batch(1, 9, 2, "nine")), IsOk());
  EXPECT_EQ(storage().GetVehicle("truck")->checks, ChecksHead());
  ASSERT_THAT(write().PutChecks(key, Step({}, 0, {}, {})), IsOk());
  ASSERT_THAT(
      write().PutChecks(key, Step({true, 0, 0}, 4, {{4, 2, 1, -5, "four"}},
                                  {Event(6, "found")})),
      IsOk());
  ASSERT_THAT(
      write().PutChecks(
          key, Step({true, 4, 1}, 8, {{7, 2, 0, 7, ""}, {8, 2, 2, 8, "eight"}},
                    {Event(8, "a"), Event(9, "b")})),
      IsOk());
  // The revision is that of the poses still.
  const std::string expected =
      "truck " + std::to_string(key) +
      ": 0 closures, 0 rejected, to 9, revision 2, 'payload', checks stored to "
      "8, event 3";
  EXPECT_EQ(ToText(*storage().GetVehicle("truck")), expected);
  // Refused whole, since the head is another.
  for (const ChecksHead& other :
       {ChecksHead{true, 4, 1}, ChecksHead{true, 8, 2}, ChecksHead{true, 7, 3},
        ChecksHead{false, 8, 3}}) {
    EXPECT_THAT(write().PutChecks(
                    key, Step(other, 9, {{8, 3, 0, 9, "x"}}, {Event(9, "x")})),
                IsError(StatusCode::kFailedPrecondition, "INTERNAL", _));
  }
  store_->Reopen();
  EXPECT_EQ(ToText(*storage().GetVehicle("truck")), expected);
  EXPECT_EQ(ToText(*storage().TakeVehicle("truck")), expected);
  const auto checks = [&](std::uint64_t first, std::uint64_t last, bool open,
                          int limit) {
    return ToTexts(*storage().ListChecks(key, first, last, open, limit));
  };
  EXPECT_THAT(checks(0, kLastSequence, false, 9),
              ElementsAre("4: 1 open, revision 2, -5 ns, 'four'",
                          "7: 0 open, revision 2, 7 ns, ''",
                          "8: 2 open, revision 2, 8 ns, 'eight'"));
  EXPECT_THAT(checks(5, 8, true, 9),
              ElementsAre("8: 2 open, revision 2, 8 ns, 'eight'"));
  EXPECT_THAT(checks(4, 7, false, 1),
              ElementsAre("4: 1 open, revision 2, -5 ns, 'four'"));
  EXPECT_THAT(ToTexts(*ReadEvents({}, 9)),
              ElementsAre("1: 6 ns, 'found'", "2: 8 ns, 'a'", "3: 9 ns, 'b'"));
  // Replaced, removed, and told in one step.
  ChecksWrite change =
      Step({true, 8, 3}, 8, {{4, 2, 0, -5, "FOUR"}}, {Event(10, "c")});
  change.removed = {8, 7, 6};
  change.after.stores = false;
  ASSERT_THAT(write().PutChecks(key, change), IsOk());
  EXPECT_THAT(checks(0, 9, false, 9),
              ElementsAre("4: 0 open, revision 2, -5 ns, 'FOUR'"));
  EXPECT_EQ(storage().GetVehicle("truck")->checks, (ChecksHead{false, 8, 4}));
}

TEST_P(StorageContract, StoresWhatAPairMakesOfChecksWithThePair) {
  const VehicleKey key = *write().Create("truck");
  ASSERT_THAT(write().Append(key, Batch(1, 9, 2, "nine")), IsOk());
  ASSERT_THAT(write().PutChecks(key, Step({}, 9, {{9, 2, 1, 5, "open"}}, {})),
              IsOk());
  const PosePairRecord pair = {"a", 9, 2, 0};
  const ChecksWrite confirmed =
      Step({true, 9, 0}, 9, {{9, 2, 0, 5, "confirmed"}}, {Event(6, "yes")});
  // Neither the one without the other.
  EXPECT_THAT(write().AddPair(key, PairKind::kLoopClosure, pair, 3,
                              Step({true, 8, 0}, 9, {}, {Event(6, "no")})),
              IsError(StatusCode::kFailedPrecondition, "INTERNAL", _));
  EXPECT_THAT(*storage().ListPosePairs(key, PairKind::kLoopClosure, "", 9),
              IsEmpty());
  ASSERT_THAT(write().AddPair(key, PairKind::kLoopClosure, pair, 3, confirmed),
              IsOk());
  EXPECT_THAT(write().AddPair(key, PairKind::kLoopClosure, pair, 4,
                              Step({true, 9, 1}, 9, {}, {Event(7, "again")})),
              IsError(StatusCode::kAlreadyExists, "LOOP_CLOSURE_EXISTS", _));
  EXPECT_THAT(ToTexts(*storage().ListChecks(key, 1, 9, false, 9)),
              ElementsAre("9: 0 open, revision 2, 5 ns, 'confirmed'"));
  EXPECT_EQ(storage().GetVehicle("truck")->revision, 3u);
  DeletedPairRecord deleted;
  deleted.pair = pair;
  EXPECT_THAT(write().DeletePair(key, deleted, 4,
                                 Step({true, 9, 0}, 9, {}, {Event(7, "no")})),
              IsError(StatusCode::kFailedPrecondition, "INTERNAL", _));
  ASSERT_THAT(
      write().DeletePair(key, deleted, 4,
                         Step({true, 9, 1}, 9, {{9, 2, 1, 5, "open again"}},
                              {Event(8, "taken back")})),
      IsOk());
  store_->Reopen();
  EXPECT_THAT(ToTexts(*storage().ListChecks(key, 1, 9, true, 9)),
              ElementsAre("9: 1 open, revision 2, 5 ns, 'open again'"));
  EXPECT_THAT(ToTexts(*ReadEvents({}, 9)),
              ElementsAre("1: 6 ns, 'yes'", "2: 8 ns, 'taken back'"));
  EXPECT_THAT(*storage().ListPosePairs(key, PairKind::kLoopClosure, "", 9),
              IsEmpty());
}

TEST_P(StorageContract, SetsChecksBackWithWhatIsGivenUp) {
  const VehicleKey key = *write().Create("truck");
  ASSERT_THAT(write().Append(key, Batch(1, 4, 2, "four")), IsOk());
  ASSERT_THAT(write().Append(key, Batch(5, 4, 3, "four")), IsOk());
  ASSERT_THAT(write().PutChecks(
                  key, Step({}, 7, {{3, 3, 1, 1, "three"}, {7, 3, 1, 2, "7"}},
                            {Event(1, "a"), Event(2, "b")})),
              IsOk());
  ASSERT_THAT(write().DropDamaged(key, 4, "payload", 4), IsOk());
  EXPECT_EQ(storage().GetVehicle("truck")->checks, (ChecksHead{true, 4, 2}));
  EXPECT_THAT(ToTexts(*storage().ListChecks(key, 1, 9, false, 9)),
              ElementsAre("3: 1 open, revision 3, 1 ns, 'three'"));
  // What was told was told.
  EXPECT_THAT(ToTexts(*ReadEvents({}, 9)),
              ElementsAre("1: 1 ns, 'a'", "2: 2 ns, 'b'"));
}

TEST_P(StorageContract, ListsTheVehiclesThatOweChecks) {
  std::map<std::string, VehicleKey> keys;
  for (const char* id : {"a", "b", "c", "d", "e"}) {
    keys[id] = *write().Create(id);
    ASSERT_THAT(write().Append(keys[id], Batch(1, 5, 2, "x")), IsOk());
  }
  ASSERT_THAT(write().PutChecks(keys["a"], Step({}, 4, {}, {})), IsOk());
  ASSERT_THAT(write().PutChecks(keys["b"], Step({}, 5, {}, {})), IsOk());
  ASSERT_THAT(write().PutChecks(keys["c"], Step({}, 0, {}, {})), IsOk());
  ChecksWrite ended = Step({}, 2, {}, {});
  ended.after.stores = false;
  ASSERT_THAT(write().PutChecks(keys["d"], ended), IsOk());
  const auto owing = [&](VehicleKey after, int limit) {
    std::vector<std::string> texts;
    const auto records = storage().ListUnchecked(after, limit);
    EXPECT_THAT(records, IsOk());
    for (const VehicleRecord& record : *records) {
      EXPECT_EQ(record.key, keys[record.id]);
      texts.push_back(record.id + " to " +
                      std::to_string(record.checks.checked_sequence));
    }
    return texts;
  };
  EXPECT_THAT(owing(0, 9), ElementsAre("a to 4", "c to 0"));
  EXPECT_THAT(owing(0, 1), ElementsAre("a to 4"));
  EXPECT_THAT(owing(keys["a"], 9), ElementsAre("c to 0"));
  ASSERT_THAT(write().Append(keys["b"], Batch(6, 1, 3, "x")), IsOk());
  ASSERT_THAT(write().Delete(keys["a"]), IsOk());
  EXPECT_THAT(owing(0, 9), ElementsAre("b to 5", "c to 0"));
}

TEST_P(StorageContract, TellsEventsOfAllVehiclesBehindAPosition) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  EXPECT_EQ(*LastEvent(), EventPosition());
  EXPECT_THAT(*ReadEvents({}, 9), IsEmpty());
  ASSERT_THAT(write().PutChecks(truck, Step({}, 0, {}, {Event(1, "t1")})),
              IsOk());
  ASSERT_THAT(
      write().PutChecks(van, Step({}, 0, {}, {Event(2, "v1"), Event(3, "v2")})),
      IsOk());
  ASSERT_THAT(
      write().PutChecks(truck, Step({true, 0, 1}, 0, {}, {Event(4, "t2")})),
      IsOk());
  store_->Reopen();
  const auto all = ReadEvents({}, 9);
  ASSERT_THAT(all, IsOk());
  ASSERT_THAT(ToTexts(*all), ElementsAre("1: 1 ns, 't1'", "1: 2 ns, 'v1'",
                                         "2: 3 ns, 'v2'", "2: 4 ns, 't2'"));
  EXPECT_EQ((*all)[0].position.key, truck);
  EXPECT_EQ((*all)[1].position.key, van);
  EXPECT_EQ(*LastEvent(), all->back().position);
  EXPECT_THAT(ToTexts(*ReadEvents((*all)[1].position, 1)),
              ElementsAre("2: 3 ns, 'v2'"));
  EXPECT_THAT(*ReadEvents(all->back().position, 9), IsEmpty());
  // A position that no event of this store has.
  for (const int i : {0, 3}) {
    EventPosition other = (*all)[static_cast<std::size_t>(i)].position;
    ++other.checksum;
    EXPECT_THAT(ReadEvents(other, 9),
                IsError(StatusCode::kOutOfRange, "CURSOR_UNKNOWN", _));
  }
  EventPosition later = all->back().position;
  later.order += 1000;
  EXPECT_THAT(ReadEvents(later, 9),
              IsError(StatusCode::kOutOfRange, "CURSOR_UNKNOWN", _));
}

TEST_P(StorageContract, KeepsThePlacesOfEventsWhenTheirVehicleIsDeleted) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  const VehicleKey silent = *write().Create("silent");
  ASSERT_THAT(write().PutChecks(truck, Step({}, 0, {{1, 1, 1, 1, "c"}},
                                            {Event(1, "t1"), Event(2, "t2")})),
              IsOk());
  ASSERT_THAT(write().PutChecks(van, Step({}, 0, {}, {Event(3, "v1")})),
              IsOk());
  const auto before = ReadEvents({}, 9);
  ASSERT_THAT(write().Delete(silent, Event(4, "farewell of none")), IsOk());
  ASSERT_THAT(write().Delete(truck, Event(5, "farewell")), IsOk());
  store_->Reopen();
  const auto after = ReadEvents({}, 9);
  ASSERT_THAT(after, IsOk());
  EXPECT_THAT(ToTexts(*after),
              ElementsAre("1: 1 ns, ''", "2: 2 ns, ''", "1: 3 ns, 'v1'",
                          "3: 5 ns, 'farewell'"));
  for (const EventRecord& event : *after) {
    EXPECT_THAT(event.damage, IsOk());
  }
  // Who had read up to one goes on behind it.
  EXPECT_THAT(ToTexts(*ReadEvents((*before)[1].position, 9)),
              ElementsAre("1: 3 ns, 'v1'", "3: 5 ns, 'farewell'"));
}

TEST_P(StorageContract, SaysThatACursorIsTooOldOnceEventsBehindItWereDropped) {
  const VehicleKey key = *write().Create("truck");
  ASSERT_THAT(write().PutChecks(key, Step({}, 0, {},
                                          {Event(10, "a"), Event(20, "b"),
                                           Event(30, "c"), Event(15, "d")})),
              IsOk());
  const auto all = ReadEvents({}, 9);
  ASSERT_THAT(DropEvents(10, 9), IsOk());
  EXPECT_EQ(ReadEvents({}, 9)->size(), 4u);
  // The oldest first, and none behind one that stays.
  ASSERT_THAT(DropEvents(25, 1), IsOk());
  EXPECT_THAT(ReadEvents({}, 9),
              IsError(StatusCode::kOutOfRange, "CURSOR_TOO_OLD", _));
  EXPECT_THAT(ToTexts(*ReadEvents((*all)[0].position, 9)),
              ElementsAre("2: 20 ns, 'b'", "3: 30 ns, 'c'", "4: 15 ns, 'd'"));
  ASSERT_THAT(DropEvents(25, 9), IsOk());
  store_->Reopen();
  EXPECT_THAT(ReadEvents((*all)[0].position, 9),
              IsError(StatusCode::kOutOfRange, "CURSOR_TOO_OLD", _));
  // What it has read is gone, but nothing behind it.
  EXPECT_THAT(ToTexts(*ReadEvents((*all)[1].position, 9)),
              ElementsAre("3: 30 ns, 'c'", "4: 15 ns, 'd'"));
  ASSERT_THAT(DropEvents(99, 9), IsOk());
  EXPECT_EQ(*LastEvent(), all->back().position);
  EXPECT_THAT(*ReadEvents(*LastEvent(), 9), IsEmpty());
  ASSERT_THAT(
      write().PutChecks(key, Step({true, 0, 4}, 0, {}, {Event(40, "e")})),
      IsOk());
  EXPECT_THAT(ToTexts(*ReadEvents(all->back().position, 9)),
              ElementsAre("5: 40 ns, 'e'"));
  // A vehicle whose events were all dropped has had some.
  ASSERT_THAT(DropEvents(99, 9), IsOk());
  ASSERT_THAT(write().Delete(key, Event(50, "farewell")), IsOk());
  EXPECT_THAT(ToTexts(*ReadEvents(*LastEvent(), 9)), IsEmpty());
  EXPECT_EQ(LastEvent()->number, 6u);
}

TEST_P(StorageContract, DoesWhatTheModelDoes) {
  std::mt19937_64 random = SeededRandom();
  MemoryStorage model;
  const std::vector<std::string> ids = {"a", "b", "c"};
  const std::vector<std::string> pairs = {"x", "y", "z"};
  std::uint64_t revision = 0;
  // Up to which the events were read.
  std::pair<EventPosition, EventPosition> read;
  // Keys of vehicles that are there, were there, and never were.
  std::vector<std::pair<VehicleKey, VehicleKey>> keys = {{99999, 99999}};
  const auto pick = [&](const auto& options) {
    return options[static_cast<std::size_t>(
        UniformInt(random, 0, static_cast<int>(options.size()) - 1))];
  };
  for (int step = 0; step < 500; ++step) {
    SCOPED_TRACE("step " + std::to_string(step));
    if (UniformInt(random, 0, 99) == 0) store_->Reopen();
    // Sometimes one that does not grow.
    revision += static_cast<std::uint64_t>(UniformInt(random, 0, 2));
    const std::string payload(
        static_cast<std::size_t>(UniformInt(random, 0, 6000)),
        static_cast<char>(UniformInt(random, 0, 255)));
    // Mostly one of the newest.
    const std::pair<VehicleKey, VehicleKey> key =
        UniformInt(random, 0, 3) == 0 ? pick(keys) : keys.back();
    std::pair<absl::Status, absl::Status> results;
    const auto both = [&](const auto& call) {
      results = {call(write(), key.first),
                 call(BlockingWrites(&model), key.second)};
    };
    const bool has_snapshots = storage().KeepsSnapshots();
    switch (UniformInt(random, has_snapshots ? -4 : 0, 12)) {
      case 11:
      case 12: {
        ChecksHead head;
        const auto vehicles = model.ListVehicles("", "", 10);
        for (const VehicleRecord& record : *vehicles) {
          if (record.key == key.second) head = record.checks;
        }
        if (UniformInt(random, 0, 5) == 0) ++head.last_event;
        ChecksWrite checks =
            Step(head, static_cast<std::uint64_t>(UniformInt(random, 0, 20)),
                 {}, {});
        for (int i = UniformInt(random, 0, 3); i > 0; --i) {
          checks.checks.push_back(
              {static_cast<std::uint64_t>(UniformInt(random, 1, 12)), revision,
               static_cast<std::uint32_t>(UniformInt(random, 0, 2)), step,
               payload});
        }
        for (int i = UniformInt(random, 0, 3); i > 0; --i) {
          checks.events.push_back(Event(step, payload + "."));
        }
        checks.after.last_event += checks.events.size();
        if (UniformInt(random, 0, 2) == 0) checks.removed.push_back(5);
        if (UniformInt(random, 0, 1) == 0) {
          both([&](BlockingWrites writes, VehicleKey k) {
            return writes.PutChecks(k, checks);
          });
          break;
        }
        const PairKind kind = kPairKinds[UniformInt(random, 0, 1)];
        const PosePairRecord pair{
            pick(pairs), static_cast<std::uint64_t>(step) + 2, 1, step};
        DeletedPairRecord deleted;
        deleted.kind = kind;
        deleted.pair = pair;
        const bool adds = UniformInt(random, 0, 1) == 0;
        both([&](BlockingWrites writes, VehicleKey k) {
          return adds ? writes.AddPair(k, kind, pair, revision, checks)
                      : writes.DeletePair(k, deleted, revision, checks);
        });
        break;
      }
      case -3: {
        const auto number =
            static_cast<std::uint32_t>(UniformInt(random, 0, 3));
        both([&](BlockingWrites writes, VehicleKey k) {
          return writes.PutSnapshotPart(k, number, payload);
        });
        break;
      }
      case -2: {
        const SnapshotRecord snapshot{
            static_cast<std::uint64_t>(UniformInt(random, 1, 9)),
            static_cast<std::uint32_t>(UniformInt(random, 0, 2)), payload};
        both([&](BlockingWrites writes, VehicleKey k) {
          return writes.PutSnapshot(k, snapshot);
        });
        break;
      }
      case -4:
        both([&](BlockingWrites writes, VehicleKey k) {
          return writes.PutMarks(k, payload);
        });
        break;
      case -1:
        if (UniformInt(random, 0, 4) != 0) break;
        both([&](BlockingWrites writes, VehicleKey k) {
          return writes.DropSnapshot(k);
        });
        break;
      case 0: {
        const std::string id = pick(ids);
        const auto real_key = write().Create(id, payload, revision);
        const auto model_key =
            BlockingWrites(&model).Create(id, payload, revision);
        results = {real_key.status(), model_key.status()};
        if (real_key.ok() && model_key.ok()) {
          keys.emplace_back(*real_key, *model_key);
        }
        break;
      }
      case 1:
        both([&](BlockingWrites writes, VehicleKey k) {
          return writes.Update(k, payload, revision);
        });
        break;
      case 2:
        if (UniformInt(random, 0, 4) != 0) break;
        both([&](BlockingWrites writes, VehicleKey k) {
          return writes.Delete(k, Event(step, "farewell"));
        });
        break;
      case 3: {
        const PairKind kind = kPairKinds[UniformInt(random, 0, 1)];
        const PosePairRecord pair{
            pick(pairs), static_cast<std::uint64_t>(step) + 2, 1, step};
        both([&](BlockingWrites writes, VehicleKey k) {
          return writes.AddPair(k, kind, pair, revision);
        });
        break;
      }
      case 4: {
        const PairKind kind = kPairKinds[UniformInt(random, 0, 1)];
        const std::string id = pick(pairs);
        both([&](BlockingWrites writes, VehicleKey k) {
          return writes.DeletePair(k, kind, id, revision);
        });
        break;
      }
      case 5: {
        std::vector<BatchRecord> revised;
        for (int i = UniformInt(random, 0, 3); i > 0; --i) {
          revised.push_back(
              Batch(static_cast<std::uint64_t>(UniformInt(random, 1, 8)),
                    static_cast<std::uint32_t>(UniformInt(random, 1, 3)), 0,
                    payload));
        }
        both([&](BlockingWrites writes, VehicleKey k) {
          return writes.Revise(k, revised, revision);
        });
        break;
      }
      case 6: {
        std::vector<BatchVersions> batches;
        auto next = static_cast<std::uint64_t>(UniformInt(random, 1, 8));
        for (int i = UniformInt(random, 1, 3); i > 0; --i) {
          const auto count =
              static_cast<std::uint32_t>(UniformInt(random, 1, 4));
          batches.push_back({Batch(next, count, revision, payload)});
          if (UniformInt(random, 0, 2) == 0) {
            batches.back().revised = Batch(next, count, revision + 1, "new");
          }
          next += count;
        }
        both([&](BlockingWrites writes, VehicleKey k) {
          return writes.Replace(k, batches, revision);
        });
        break;
      }
      default: {
        // At the end of the vehicle, or a little off.
        std::uint64_t next = 1;
        const auto vehicles = model.ListVehicles("", "", 10);
        for (const VehicleRecord& record : *vehicles) {
          if (record.key == key.second) next = record.durable_sequence + 1;
        }
        if (UniformInt(random, 0, 4) == 0) {
          next += static_cast<std::uint64_t>(UniformInt(random, 0, 2));
        }
        std::vector<BatchRecord> batches;
        for (int i = UniformInt(random, 1, 3); i > 0; --i) {
          batches.push_back(
              Batch(next, static_cast<std::uint32_t>(UniformInt(random, 1, 3)),
                    revision, payload));
          next += batches.back().count;
        }
        std::optional<std::string> vehicle;
        if (UniformInt(random, 0, 3) == 0) vehicle = payload + "!";
        both([&](BlockingWrites writes, VehicleKey k) {
          return writes.AppendAll(k, batches, vehicle);
        });
        break;
      }
    }
    ASSERT_EQ(results.first.code(), results.second.code())
        << results.first << " instead of " << results.second;
    ASSERT_EQ(ReasonOf(results.first), ReasonOf(results.second));

    if (UniformInt(random, 0, 9) == 0) {
      const std::int64_t before = step - UniformInt(random, 0, 99);
      const int most = UniformInt(random, 1, 9);
      store_->AwaitEvents();
      both([&](BlockingWrites writes, VehicleKey) {
        return writes.DropEvents(before, most);
      });
      ASSERT_THAT(results.first, IsOk());
      ASSERT_THAT(results.second, IsOk());
    }
    const auto real_events = ReadEvents(read.first, 999);
    const auto model_events = model.ReadEvents(read.second, 999);
    ASSERT_EQ(ReasonOf(real_events.status()), ReasonOf(model_events.status()));
    if (!real_events.ok()) {
      read = {*LastEvent(), *model.LastEvent()};
    } else {
      ASSERT_EQ(ToTexts(*real_events), ToTexts(*model_events));
      if (!real_events->empty() && UniformInt(random, 0, 20) == 0) {
        const auto last = static_cast<std::size_t>(
            UniformInt(random, 0, static_cast<int>(real_events->size()) - 1));
        read = {(*real_events)[last].position, (*model_events)[last].position};
      }
    }

    const auto real_vehicles = storage().ListVehicles("", "", 10);
    const auto model_vehicles = model.ListVehicles("", "", 10);
    ASSERT_THAT(real_vehicles, IsOk());
    ASSERT_EQ(real_vehicles->size(), model_vehicles->size());
    for (std::size_t i = 0; i < real_vehicles->size(); ++i) {
      VehicleRecord real = (*real_vehicles)[i];
      const VehicleRecord& expected = (*model_vehicles)[i];
      const VehicleKey real_key = std::exchange(real.key, expected.key);
      ASSERT_EQ(ToText(real), ToText(expected));
      for (const PairKind kind : kPairKinds) {
        ASSERT_EQ(ToTexts(*storage().ListPosePairs(real_key, kind, "", 10)),
                  ToTexts(*model.ListPosePairs(expected.key, kind, "", 10)));
      }
      ASSERT_EQ(ToTexts(*storage().ListDeletedPairs(real_key)),
                ToTexts(*model.ListDeletedPairs(expected.key)));
      ASSERT_EQ(ToTexts(*storage().ListChecks(real_key, 1, 15, false, 99)),
                ToTexts(*model.ListChecks(expected.key, 1, 15, false, 99)));
      if (storage().KeepsSnapshots()) {
        ASSERT_EQ(SnapshotOf(storage(), real_key),
                  SnapshotOf(model, expected.key));
        ASSERT_EQ(MarksOf(storage(), real_key), MarksOf(model, expected.key));
      }
      if (expected.durable_sequence == 0) continue;
      const auto first = static_cast<std::uint64_t>(
          UniformInt(random, 1, static_cast<int>(expected.durable_sequence)));
      for (const BatchVersion version :
           {BatchVersion::kAsSent, BatchVersion::kCurrent}) {
        const auto real_batches =
            ReadAll(storage(), real_key, first, real.durable_sequence, version);
        ASSERT_THAT(real_batches, IsOk());
        ASSERT_EQ(ToTexts(*real_batches),
                  ToTexts(*ReadAll(model, expected.key, first,
                                   real.durable_sequence, version)));
      }
    }
  }
}

}  // namespace revisit::server
