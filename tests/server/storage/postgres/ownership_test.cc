// Two and more servers over one database.
#include "server/storage/postgres/ownership.h"

#include <atomic>
#include <chrono>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <random>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/storage/postgres/postgres_reader.h"
#include "server/storage/postgres/postgres_storage.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/memory_storage.h"
#include "tests/server/storage/postgres/postgres_server.h"
#include "tests/server/storage_testing.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using std::chrono::milliseconds;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::Pair;

const auto kFenced = IsError(StatusCode::kAborted, "EPOCH_FENCED", _);
const auto kNotOwner = IsError(StatusCode::kUnavailable, "NOT_OWNER", _);
const auto kLeaseStale = IsError(StatusCode::kUnavailable, "LEASE_STALE", _);
const auto kUnavailable =
    IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE", _);

constexpr milliseconds kLeastStay{3'000};

// A clock that a test sets, for all servers of it.
class TestClock {
 public:
  void Advance(milliseconds by) { now_ += by.count(); }
  std::function<std::chrono::nanoseconds()> Reader() const {
    return [this] { return milliseconds(now_); };
  }

 private:
  std::atomic<std::int64_t> now_{1'000'000};
};

BatchRecord One(std::uint64_t sequence) {
  return BatchRecord{sequence, 1, sequence + 1,
                     "pose " + std::to_string(sequence)};
}

// Every kind of write, of a vehicle that Prepare() made.
using Write = std::function<absl::Status(BlockingWrites, VehicleKey)>;
std::vector<std::pair<const char*, Write>> KindsOfWrites() {
  return {
      {"append", [](auto w, auto k) { return w.Append(k, One(3)); }},
      {"append with vehicle",
       [](auto w, auto k) { return w.AppendWithVehicle(k, One(3), "new"); }},
      {"update", [](auto w, auto k) { return w.Update(k, "new", 9); }},
      {"delete", [](auto w, auto k) { return w.Delete(k); }},
      {"revise", [](auto w, auto k) { return w.Revise(k, {One(1)}, 9); }},
      {"revise nothing", [](auto w, auto k) { return w.Revise(k, {}, 9); }},
      {"drop", [](auto w, auto k) { return w.DropDamaged(k, 1, "new", 9); }},
      {"add a pair",
       [](auto w, auto k) {
         return w.AddPair(k, PairKind::kLoopClosure, {"d", 2, 1, 0}, 9);
       }},
      {"delete a pair",
       [](auto w, auto k) {
         return w.DeletePair(k, PairKind::kLoopClosure, "c", 9);
       }},
      {"begin a snapshot",
       [](auto w, auto k) { return w.PutSnapshotPart(k, 0, "new"); }},
      {"add to a snapshot",
       [](auto w, auto k) { return w.PutSnapshotPart(k, 1, "new"); }},
      {"put a snapshot",
       [](auto w, auto k) {
         return w.PutSnapshot(k, {2, 1, "new"});
       }},
      {"put marks", [](auto w, auto k) { return w.PutMarks(k, "new"); }},
      {"drop a snapshot", [](auto w, auto k) { return w.DropSnapshot(k); }},
      {"confirm", [](auto w, auto k) { return w.Confirm(k); }},
  };
}

// A vehicle of two poses, a loop closure, a snapshot and marks, of this server.
VehicleKey Prepare(Storage* storage, const std::string& id) {
  BlockingWrites writes(storage);
  const VehicleKey key = *writes.Create(id);
  for (std::uint64_t i = 1; i <= 2; ++i) {
    EXPECT_THAT(writes.Append(key, One(i)), IsOk());
  }
  EXPECT_THAT(writes.AddPair(key, PairKind::kLoopClosure, {"c", 2, 1, 0}, 4),
              IsOk());
  EXPECT_THAT(writes.PutSnapshotPart(key, 0, "part"), IsOk());
  EXPECT_THAT(writes.PutSnapshot(key, {1, 1, "rest"}), IsOk());
  EXPECT_THAT(writes.PutMarks(key, "marks"), IsOk());
  return key;
}

// Notes the vehicles that a storage says others ask for, as long as this lives.
class WantedOf {
 public:
  explicit WantedOf(Storage* storage) : storage_(storage) {
    storage->OnWanted([this](const WantedVehicle& wanted) {
      const std::lock_guard<std::mutex> guard(mutex_);
      vehicles_[wanted.id] = wanted.key;
    });
  }
  ~WantedOf() { storage_->OnWanted(nullptr); }

  std::map<std::string, VehicleKey> vehicles() const {
    const std::lock_guard<std::mutex> guard(mutex_);
    return vehicles_;
  }
  void Clear() {
    const std::lock_guard<std::mutex> guard(mutex_);
    vehicles_.clear();
  }

 private:
  Storage* const storage_;
  mutable std::mutex mutex_;
  std::map<std::string, VehicleKey> vehicles_;
};

class OwnershipTest : public ::testing::Test {
 protected:
  void SetUp() override {
    if (Server() == nullptr) {
      GTEST_SKIP() << "PostgreSQL's server programs are not installed";
    }
    conninfo_ = Server()->MakeStore();
  }

  static PostgresServer* Server() { return PostgresServer::Shared(); }

  std::string Sql(const std::string& sql) const {
    return Server()->Run(conninfo_, sql);
  }

  // A server that beats often, unless `beats` is false: then it is one that was
  // stopped right after it joined.
  std::unique_ptr<Storage> Open(const std::string& address, bool beats = true) {
    PostgresOptions options;
    options.ownership.address = address;
    options.ownership.beat_period =
        beats ? milliseconds(20) : milliseconds(3'600'000);
    options.ownership.least_stay = kLeastStay;
    options.ownership.now = clock_.Reader();
    auto storage = OpenPostgresStorage(conninfo_, options);
    EXPECT_THAT(storage, IsOk());
    return storage.ok() ? *std::move(storage) : nullptr;
  }

  // As if others had missed the beats of the server for its lease.
  void Bury(const std::string& address) const {
    Sql("UPDATE servers SET state = 'dead' WHERE address = '" + address + "'");
  }

  // A failover does the same.
  void EndSessions() const {
    Sql("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE "
        "datname = current_database() AND pid <> pg_backend_pid()");
  }

  std::int64_t BeatsOf(const std::string& address) const {
    return std::stoll(
        Sql("SELECT beat FROM servers WHERE address = '" + address + "'"));
  }

  // Waits until a backend of the database waits for that.
  void AwaitWaiting(const std::string& wait_event_type,
                    const std::string& but = "0") const {
    EXPECT_TRUE(Eventually([&] {
      return !Waiting(wait_event_type, but).empty();
    })) << wait_event_type;
  }
  std::string Waiting(const std::string& wait_event_type,
                      const std::string& but = "0") const {
    return Sql(
        "SELECT pid FROM pg_stat_activity WHERE datname = current_database() "
        "AND state = 'active' AND query NOT LIKE '%pg_stat_activity%' AND "
        "query NOT LIKE 'UPDATE servers%' AND wait_event_type = '" +
        wait_event_type + "' AND pid NOT IN (" + but + ")");
  }

  // What is stored, whoever asks.
  std::string Stored(Storage& storage, const std::string& id) {
    const auto record = storage.GetVehicle(id);
    return record.ok() ? ToText(*record)
                       : std::string(record.status().message());
  }

  TestClock clock_;
  std::string conninfo_;
};

// A setting of the server that all tests share, until it is reset or this ends,
// also by a check that fails.
class ServerSetting {
 public:
  ServerSetting(PostgresServer* server, const std::string& name,
                const std::string& value)
      : server_(server), name_(name) {
    Apply("SET " + name_ + " = '" + value + "'");
  }
  ~ServerSetting() { Reset(); }

  ServerSetting(const ServerSetting&) = delete;
  ServerSetting& operator=(const ServerSetting&) = delete;

  void Reset() { Apply("RESET " + name_); }

 private:
  void Apply(const std::string& change) {
    server_->RunAsAdmin("ALTER SYSTEM " + change);
    server_->RunAsAdmin("SELECT pg_reload_conf()");
  }

  PostgresServer* const server_;
  const std::string name_;
};

// SQL in a transaction of its own that stays open.
class OpenTransaction {
 public:
  explicit OpenTransaction(const std::string& conninfo) {
    PostgresConnection::Options options;
    options.conninfo = conninfo;
    connection_ = *PostgresConnection::Open(options);
    Run("BEGIN");
  }
  void Run(const std::string& sql) {
    EXPECT_THAT(connection_->RunText(sql), IsOk()) << sql;
  }
  void Commit() { Run("COMMIT"); }
  void RollBack() { Run("ROLLBACK"); }

 private:
  std::unique_ptr<PostgresConnection> connection_;
};

TEST_F(OwnershipTest, OwnerThatWasTakenForDeadWritesNothing) {
  const auto a = Open("a", /*beats=*/false);
  const auto b = Open("b");
  BlockingWrites write(a.get());
  const VehicleKey key = *write.Create("truck");
  ASSERT_THAT(write.Append(key, One(1)), IsOk());
  ASSERT_THAT(write.AddPair(key, PairKind::kLoopClosure, {"c", 1, 1, 0}, 3),
              IsOk());
  Bury("a");
  ASSERT_THAT(b->TakeVehicle("truck"), IsOk());
  const std::string before = Stored(*b, "truck");
  EXPECT_THAT(write.Append(key, One(2)), kFenced);
  EXPECT_EQ(Stored(*b, "truck"), before);
  EXPECT_THAT(a->CheckOwned(key), kFenced);
  EXPECT_THAT(BlockingWrites(b.get()).Append(key, One(2)), IsOk());
}

TEST_F(OwnershipTest, CountsWhatItOwnsAndWhatOthersTook) {
  const auto a = Open("a", /*beats=*/false);
  const auto b = Open("b");
  BlockingWrites write(a.get());
  const VehicleKey taken = *write.Create("taken");
  const VehicleKey given = *write.Create("given");
  SharingState sharing = *a->GetSharing();
  EXPECT_EQ(sharing.owned_vehicles, 2);
  EXPECT_TRUE(sharing.lease_holds);
  // What is handed over is not lost.
  a->ReleaseVehicle(given);
  ASSERT_TRUE(Eventually([&] { return b->TakeVehicle("given").ok(); }));
  EXPECT_EQ(a->GetSharing()->owned_vehicles, 1);
  EXPECT_EQ(a->GetSharing()->lost_vehicles, 0u);
  Bury("a");
  ASSERT_THAT(b->TakeVehicle("taken"), IsOk());
  EXPECT_THAT(write.Append(taken, One(1)), kFenced);
  sharing = *a->GetSharing();
  EXPECT_EQ(sharing.owned_vehicles, 0);
  EXPECT_EQ(sharing.lost_vehicles, 1u);
  EXPECT_EQ(sharing.lost_leases, 0u);
  EXPECT_EQ(b->GetSharing()->owned_vehicles, 2);
  clock_.Advance(milliseconds(100'000));
  EXPECT_FALSE(a->GetSharing()->lease_holds);
  EXPECT_THAT(a->CheckWritable(), kLeaseStale);
}

TEST_F(OwnershipTest, NoKindOfWritePassesTheFence) {
  const auto b = Open("b");
  for (const auto& [what, write] : KindsOfWrites()) {
    SCOPED_TRACE(what);
    const std::string id = std::string("of ") + what;
    const auto a = Open("a", /*beats=*/false);
    const VehicleKey key = Prepare(a.get(), id);
    Bury("a");
    ASSERT_THAT(b->TakeVehicle(id), IsOk());
    const std::string before = Stored(*b, id);
    EXPECT_THAT(write(BlockingWrites(a.get()), key), kFenced);
    EXPECT_EQ(Stored(*b, id), before);
    EXPECT_EQ(SnapshotOf(*b, key), "to 1: part, 'rest'");
    EXPECT_EQ(MarksOf(*b, key), "marks");
    EXPECT_THAT(
        ToTexts(*ReadAll(*b, key, 1, 2)),
        ElementsAre("1+1, revision 2, 'pose 1'", "2+1, revision 3, 'pose 2'"));
    EXPECT_THAT(write(BlockingWrites(b.get()), key), IsOk());
  }
}

// Only lost poses were noticed: whatever else was lost, writes went on on top
// of it.
TEST_F(OwnershipTest, NoKindOfWriteGoesToADatabaseThatLacksTheOneBefore) {
  const auto a = Open("a");
  for (const auto& [what, write] : KindsOfWrites()) {
    SCOPED_TRACE(what);
    const std::string id = std::string("of ") + what;
    const VehicleKey key = Prepare(a.get(), id);
    // A failover to a standby that lacked the last commit leaves the same.
    Sql("DELETE FROM loop_closures; UPDATE heads SET revision = 3 WHERE key "
        "= " +
        std::to_string(key));
    const std::string before = Stored(*a, id);
    EXPECT_THAT(write(BlockingWrites(a.get()), key), kFenced);
    EXPECT_EQ(Stored(*a, id), before);
    EXPECT_EQ(SnapshotOf(*a, key), "to 1: part, 'rest'");
    EXPECT_EQ(MarksOf(*a, key), "marks");
    EXPECT_THAT(a->CheckOwned(key), kFenced);
    const auto taken = a->TakeVehicle(id);
    ASSERT_THAT(taken, IsOk());
    EXPECT_EQ(taken->revision, 3u);
    EXPECT_THAT(BlockingWrites(a.get()).Update(key, "new", 4), IsOk());
  }
}

TEST_F(OwnershipTest, VehicleOfALivingServerIsHandedOverAfterAWhileIfAskedFor) {
  const auto a = Open("host-a:1");
  const auto b = Open("host-b:2");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  EXPECT_THAT(a->CheckOwned(key), IsOk());
  WantedOf wanted(a.get());
  const absl::Status refused = b->TakeVehicle("truck").status();
  EXPECT_THAT(refused, kNotOwner);
  EXPECT_EQ(MetadataOf(refused, "owner"), "host-a:1");
  EXPECT_EQ(MetadataOf(refused, "epoch"), "1");
  EXPECT_THAT(b->CheckOwned(key), kFenced);
  const std::int64_t beats = BeatsOf("host-a:1");
  EXPECT_TRUE(Eventually([&] { return BeatsOf("host-a:1") > beats + 1; }));
  EXPECT_THAT(wanted.vehicles(), IsEmpty());
  clock_.Advance(kLeastStay);
  EXPECT_TRUE(Eventually([&] { return !wanted.vehicles().empty(); }));
  EXPECT_THAT(wanted.vehicles(), ElementsAre(Pair("truck", key)));
  // Until it is let go.
  wanted.Clear();
  EXPECT_TRUE(Eventually([&] { return !wanted.vehicles().empty(); }));
  ASSERT_THAT(BlockingWrites(a.get()).Append(key, One(1)), IsOk());
  a->ReleaseVehicle(key);
  EXPECT_THAT(a->CheckOwned(key), kFenced);
  EXPECT_TRUE(Eventually([&] { return b->TakeVehicle("truck").ok(); }));
  EXPECT_THAT(b->CheckOwned(key), IsOk());
  EXPECT_THAT(BlockingWrites(b.get()).Append(key, One(2)), IsOk());
  EXPECT_THAT(BlockingWrites(a.get()).Append(key, One(3)), kFenced);
  EXPECT_EQ(Sql("SELECT count(*) FROM handovers"), "0\n");
  wanted.Clear();
  const std::int64_t before = BeatsOf("host-a:1");
  EXPECT_TRUE(Eventually([&] { return BeatsOf("host-a:1") > before + 2; }));
  EXPECT_THAT(wanted.vehicles(), IsEmpty());
}

TEST_F(OwnershipTest, ServerThatLeavesHandsOverAtOnceWhatOthersAskFor) {
  const auto a = Open("host-a:1");
  const auto b = Open("host-b:2");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  EXPECT_THAT(b->TakeVehicle("truck").status(), kNotOwner);
  a->OnWanted([&](const WantedVehicle& wanted) {
    EXPECT_EQ(wanted.key, key);
    a->ReleaseVehicle(key);
  });
  a->Leave();
  EXPECT_TRUE(Eventually([&] { return b->TakeVehicle("truck").ok(); }));
}

// Whoever ends the calls may go then.
TEST_F(OwnershipTest, CallThatHandsAVehicleOverIsOverOnceAnotherTakesItsPlace) {
  const auto a = Open("host-a:1");
  const auto b = Open("host-b:2");
  ASSERT_THAT(BlockingWrites(a.get()).Create("truck"), IsOk());
  EXPECT_THAT(b->TakeVehicle("truck").status(), kNotOwner);
  const Answer<bool> called;
  // It belongs to the storage's thread, then to this one.
  bool is_over = false;
  a->OnWanted([&](const WantedVehicle&) {
    if (is_over) return;
    called.Set(true);
    std::this_thread::sleep_for(milliseconds(100));
    is_over = true;
  });
  a->Leave();
  called.Get();
  a->OnWanted(nullptr);
  EXPECT_TRUE(is_over);
}

TEST_F(OwnershipTest, VehicleThatIsHandedOverIsWithOneServerOrTheOther) {
  const auto a = Open("host-a:1");
  const auto b = Open("host-b:2");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  Storage* from = a.get();
  Storage* to = b.get();
  for (int round = 0; round < 200; ++round) {
    from->ReleaseVehicle(key);
    absl::Status taken = to->TakeVehicle("truck").status();
    while (!taken.ok()) {
      // Also when it becomes free just after it was not.
      ASSERT_THAT(taken, kNotOwner);
      taken = to->TakeVehicle("truck").status();
    }
    std::swap(from, to);
  }
}

TEST_F(OwnershipTest, LivingServersAreListedWithTheVehiclesThatTheyOwn) {
  const auto a = Open("host-a:1");
  const auto b = Open("host-b:2");
  ASSERT_THAT(BlockingWrites(a.get()).Create("truck"), IsOk());
  ASSERT_THAT(BlockingWrites(a.get()).Create("van"), IsOk());
  ASSERT_THAT(BlockingWrites(b.get()).Create("bus"), IsOk());
  const auto c = Open("host-c:3");
  const auto users_of = [](Storage& storage) {
    const auto users = storage.ListUsers();
    std::vector<std::string> texts;
    if (!users.ok()) return texts;
    for (const StorageUser& user : *users) {
      texts.push_back(user.address + " " + std::to_string(user.owned_vehicles));
    }
    return texts;
  };
  EXPECT_EQ(users_of(*c).size(), 3u);
  const std::vector<std::string> all = {"host-a:1 2", "host-b:2 1",
                                        "host-c:3 0"};
  EXPECT_TRUE(Eventually([&] { return users_of(*c) == all; }));
  EXPECT_EQ(users_of(**OpenPostgresStorageToRead(conninfo_)), all);
  Bury("host-b:2");
  // It joins again, without the vehicles that it had.
  EXPECT_TRUE(Eventually([&] {
    return users_of(*c) ==
           std::vector<std::string>{"host-a:1 2", "host-b:2 0", "host-c:3 0"};
  }));
}

// A count of them took longer the more vehicles there were.
TEST_F(OwnershipTest, ServersAreListedWithoutAskingTheDatabase) {
  const auto a = Open("a");
  OpenTransaction away(conninfo_);
  away.Run("LOCK TABLE servers, heads IN ACCESS EXCLUSIVE MODE");
  EXPECT_EQ(a->ListUsers()->size(), 1u);
  clock_.Advance(milliseconds(20'000));
  EXPECT_THAT(a->ListUsers(), kLeaseStale);
  away.RollBack();
}

TEST_F(OwnershipTest, TakingAVehicleThatIsNotThereIsNotFound) {
  const auto a = Open("a");
  EXPECT_THAT(a->TakeVehicle("truck"),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
}

TEST_F(OwnershipTest, ServerThatEndsInOrderFreesItsVehiclesAtOnce) {
  auto a = Open("a");
  const auto b = Open("b", /*beats=*/false);
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  ASSERT_THAT(BlockingWrites(a.get()).Append(key, One(1)), IsOk());
  a.reset();
  const auto taken = b->TakeVehicle("truck");
  ASSERT_THAT(taken, IsOk());
  EXPECT_EQ(taken->durable_sequence, 1u);
}

// Otherwise the first to come back would take all others for dead.
TEST_F(OwnershipTest, NobodyIsBuriedForASilenceInWhichNobodyCouldBeat) {
  const auto a = Open("a");
  const auto b = Open("b");
  const auto c = Open("c");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  OpenTransaction away(conninfo_);
  away.Run("LOCK TABLE servers IN ACCESS EXCLUSIVE MODE");
  clock_.Advance(milliseconds(20'000));
  EXPECT_THAT(a->CheckOwned(key), kLeaseStale);
  std::this_thread::sleep_for(milliseconds(2'500));
  away.Commit();
  for (const char* const server : {"a", "b", "c"}) {
    const std::int64_t beats = BeatsOf(server);
    EXPECT_TRUE(Eventually([&] { return BeatsOf(server) > beats + 2; }));
  }
  EXPECT_EQ(Sql("SELECT count(*) FROM servers WHERE state = 'dead'"), "0\n");
  EXPECT_THAT(a->CheckOwned(key), IsOk());
}

TEST_F(OwnershipTest, SilentServerIsBuriedAfterItsLeaseAndNotBefore) {
  const auto a = Open("a", /*beats=*/false);
  const auto b = Open("b");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  const auto state_of_a = [&] {
    return Sql("SELECT state FROM servers WHERE address = 'a'");
  };
  const auto beats_of_b = [&] {
    return std::stoll(Sql("SELECT beat FROM servers WHERE address = 'b'"));
  };
  const auto await_beats = [&] {
    const auto seen = beats_of_b();
    EXPECT_TRUE(Eventually([&] { return beats_of_b() > seen + 2; }));
  };
  await_beats();
  clock_.Advance(milliseconds(8'900));
  // From its last tenth on, the owner does not answer from memory.
  EXPECT_THAT(a->CheckOwned(key), IsOk());
  await_beats();
  clock_.Advance(milliseconds(200));
  EXPECT_THAT(a->CheckOwned(key), kLeaseStale);
  EXPECT_THAT(a->TakeVehicle("truck"), kLeaseStale);
  await_beats();
  EXPECT_EQ(state_of_a(), "live\n");
  EXPECT_THAT(b->TakeVehicle("truck"), kNotOwner);
  // A lease does not make a write safe, and none needs it.
  EXPECT_THAT(BlockingWrites(a.get()).Append(key, One(1)), IsOk());
  clock_.Advance(milliseconds(1'000));
  EXPECT_TRUE(Eventually([&] { return state_of_a() == "dead\n"; }));
  EXPECT_THAT(b->TakeVehicle("truck"), IsOk());
  EXPECT_THAT(BlockingWrites(a.get()).Append(key, One(2)), kFenced);
}

TEST_F(OwnershipTest,
       LeaseHoldsAgainAfterABeatIfNobodyHasTakenTheServerForDead) {
  const auto a = Open("a");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  clock_.Advance(milliseconds(100'000));
  EXPECT_TRUE(Eventually([&] { return a->CheckOwned(key).ok(); }));
  EXPECT_THAT(BlockingWrites(a.get()).Append(key, One(1)), IsOk());
}

TEST_F(OwnershipTest, ServerThatFindsItselfDeadGivesUpAllAndGoesOnAsAnother) {
  const auto a = Open("a");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  const std::string before = Sql("SELECT incarnation FROM servers");
  Bury("a");
  EXPECT_TRUE(Eventually([&] { return !a->CheckOwned(key).ok(); }));
  EXPECT_THAT(a->CheckOwned(key), kFenced);
  EXPECT_TRUE(Eventually([&] {
    return Sql("SELECT count(*) FROM servers WHERE state = 'live'") == "1\n";
  }));
  EXPECT_NE(Sql("SELECT incarnation FROM servers WHERE state = 'live'"),
            before);
  EXPECT_EQ(a->GetSharing()->lost_leases, 1u);
  EXPECT_EQ(a->GetSharing()->lost_vehicles, 1u);
  EXPECT_THAT(BlockingWrites(a.get()).Append(key, One(1)), kFenced);
  ASSERT_TRUE(Eventually([&] { return a->TakeVehicle("truck").ok(); }));
  EXPECT_THAT(a->CheckOwned(key), IsOk());
  EXPECT_THAT(BlockingWrites(a.get()).Append(key, One(1)), IsOk());
}

TEST_F(OwnershipTest, ClaimWaitsForAnAppendUnderWayAndSeesIt) {
  const auto a = Open("a", /*beats=*/false);
  const auto b = Open("b");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  // The append has changed the head, and waits to insert its row.
  OpenTransaction lock(conninfo_);
  lock.Run("INSERT INTO batches SELECT key, 1, 1, 0, 0, 0, '' FROM heads");
  const Answer<absl::Status> appended;
  AppendBatch(*a, key, One(1), std::nullopt, appended.Setter());
  AwaitWaiting("Lock");
  std::string appending = Waiting("Lock");
  appending.pop_back();
  Bury("a");
  const Answer<absl::StatusOr<VehicleRecord>> taken;
  std::thread taking([&] { taken.Set(b->TakeVehicle("truck")); });
  AwaitWaiting("Lock", appending);
  EXPECT_FALSE(taken.IsSet());
  lock.RollBack();
  taking.join();
  EXPECT_THAT(appended.Get(), IsOk());
  ASSERT_THAT(taken.Get(), IsOk());
  EXPECT_EQ(taken.Get()->durable_sequence, 1u);
  EXPECT_THAT(BlockingWrites(a.get()).Append(key, One(2)), kFenced);
}

TEST_F(OwnershipTest, AppendWaitsForAClaimUnderWayAndWritesNothing) {
  const auto a = Open("a", /*beats=*/false);
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  OpenTransaction claim(conninfo_);
  claim.Run("UPDATE heads SET owner = gen_random_uuid(), epoch = epoch + 1");
  const Answer<absl::Status> appended;
  AppendBatch(*a, key, One(1), std::nullopt, appended.Setter());
  AwaitWaiting("Lock");
  EXPECT_FALSE(appended.IsSet());
  claim.Commit();
  EXPECT_THAT(appended.Get(), kFenced);
  EXPECT_EQ(Sql("SELECT count(*) FROM batches"), "0\n");
  EXPECT_THAT(a->CheckOwned(key), kFenced);
}

TEST_F(OwnershipTest,
       OfTwoClaimsTheSecondDoesNotTakeFromAServerThatJoinedMeanwhile) {
  const auto b = Open("b");
  const VehicleKey key = *BlockingWrites(b.get()).Create("truck");
  b->ReleaseVehicle(key);
  EXPECT_TRUE(Eventually(
      [&] { return Sql("SELECT owner IS NULL FROM heads") == "t\n"; }));
  OpenTransaction claim(conninfo_);
  claim.Run(
      "INSERT INTO servers (incarnation, address, lease_ms, state) VALUES "
      "('00000000-0000-0000-0000-00000000000c', 'c', 1000000, 'live')");
  claim.Run(
      "UPDATE heads SET epoch = epoch + 1, "
      "owner = '00000000-0000-0000-0000-00000000000c'");
  const Answer<absl::StatusOr<VehicleRecord>> taken;
  std::thread taking([&] { taken.Set(b->TakeVehicle("truck")); });
  AwaitWaiting("Lock");
  claim.Commit();
  taking.join();
  EXPECT_THAT(taken.Get(), kNotOwner);
  EXPECT_EQ(Sql("SELECT owner FROM heads"),
            "00000000-0000-0000-0000-00000000000c\n");
}

TEST_F(OwnershipTest,
       WriteWhoseBackendWasEndedHasToBeSettledByTakingTheVehicle) {
  const auto a = Open("a");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  OpenTransaction lock(conninfo_);
  lock.Run("LOCK TABLE batches IN SHARE MODE");
  const Answer<absl::Status> first;
  const Answer<absl::Status> second;
  AppendBatch(*a, key, One(1), std::nullopt, first.Setter());
  AwaitWaiting("Lock");
  AppendBatch(*a, key, One(2), std::nullopt, second.Setter());
  Sql("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE "
      "wait_event_type = 'Lock' AND datname = current_database()");
  EXPECT_THAT(first.Get(), kUnavailable);
  lock.Commit();
  // It was submitted under the claim that is in doubt.
  EXPECT_THAT(second.Get(), kFenced);
  EXPECT_THAT(a->CheckOwned(key), kFenced);
  const auto taken = a->TakeVehicle("truck");
  ASSERT_THAT(taken, IsOk());
  EXPECT_EQ(taken->durable_sequence, 0u);
  EXPECT_THAT(BlockingWrites(a.get()).Append(key, One(1)), IsOk());
}

TEST_F(OwnershipTest, WritesThatWaitAreNotWrittenUnderALaterClaim) {
  const auto a = Open("a");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  OpenTransaction lock(conninfo_);
  lock.Run("LOCK TABLE rejected_candidates IN SHARE MODE");
  // Holds up the connection that writes, and a row that is not the vehicle's.
  const VehicleKey other = key + 2;
  Sql("INSERT INTO vehicles VALUES (" + std::to_string(other) +
      ", 'other', 0, 0, 0, ''); INSERT INTO heads VALUES (" +
      std::to_string(other) + ")");
  ASSERT_THAT(a->TakeVehicle("other"), IsOk());
  const Answer<absl::Status> held;
  const Answer<absl::Status> waiting;
  a->AddPosePair(other, PairKind::kRejectedCandidate, {"a", 2, 1, 0},
                 std::nullopt, 2, held.Setter());
  AwaitWaiting("Lock");
  AppendBatch(*a, key, One(1), std::nullopt, waiting.Setter());
  ASSERT_THAT(a->TakeVehicle("truck"), IsOk());
  lock.Commit();
  EXPECT_THAT(held.Get(), IsOk());
  EXPECT_THAT(waiting.Get(), kFenced);
  EXPECT_EQ(a->GetVehicle("truck")->durable_sequence, 0u);
}

TEST_F(OwnershipTest, VehicleThatItsOwnerHasForgottenIsFreedWhenAskedFor) {
  const auto a = Open("a");
  const auto b = Open("b");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  OpenTransaction lock(conninfo_);
  lock.Run("LOCK TABLE batches IN SHARE MODE");
  const Answer<absl::Status> appended;
  AppendBatch(*a, key, One(1), std::nullopt, appended.Setter());
  AwaitWaiting("Lock");
  Sql("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE "
      "wait_event_type = 'Lock' AND datname = current_database()");
  EXPECT_THAT(appended.Get(), kUnavailable);
  lock.Commit();
  EXPECT_THAT(b->TakeVehicle("truck"), kNotOwner);
  // It stays as long as one that is not forgotten.
  const std::int64_t beats = BeatsOf("a");
  EXPECT_TRUE(Eventually([&] { return BeatsOf("a") > beats + 2; }));
  EXPECT_THAT(b->TakeVehicle("truck"), kNotOwner);
  clock_.Advance(kLeastStay);
  EXPECT_TRUE(Eventually([&] { return b->TakeVehicle("truck").ok(); }));
}

TEST_F(OwnershipTest, ManyVehiclesAreAskedForAFewAtATime) {
  const auto a = Open("a");
  const auto b = Open("b");
  const int fewest = static_cast<int>(AskPacing::kFewest);
  BlockingWrites writes(a.get());
  const auto id = [](int i) { return "truck-" + std::to_string(i); };
  for (int i = 0; i < fewest + 10; ++i)
    ASSERT_THAT(writes.Create(id(i)), IsOk());
  for (int i = 0; i < fewest + 10; ++i) {
    EXPECT_THAT(b->TakeVehicle(id(i)), kNotOwner);
  }
  EXPECT_EQ(Sql("SELECT count(*) FROM handovers"),
            std::to_string(fewest) + "\n");
  clock_.Advance(kLeastStay);
  const WantedOf wanted(a.get());
  EXPECT_TRUE(Eventually(
      [&] { return static_cast<int>(wanted.vehicles().size()) == fewest; }));
  // What comes makes room for the next.
  for (const auto& [id_of_wanted, key] : wanted.vehicles()) {
    a->ReleaseVehicle(key);
    EXPECT_TRUE(Eventually([&] { return b->TakeVehicle(id_of_wanted).ok(); }));
  }
  for (int i = fewest; i < fewest + 10; ++i) {
    EXPECT_THAT(b->TakeVehicle(id(i)), kNotOwner);
  }
  EXPECT_EQ(Sql("SELECT count(*) FROM handovers"), "10\n");
}

TEST_F(OwnershipTest,
       AppendThatWaitsForAStandbyAndIsCancelledIsNotAcknowledged) {
  const auto a = Open("a");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  EXPECT_EQ(a->GetDurability().level, Durability::Level::kNone);
  ServerSetting standbys(Server(), "synchronous_standby_names", "nobody");
  // Commits wait from when the checkpointer has seen the setting on, as the
  // server's next beat does.
  ASSERT_TRUE(Eventually([&] {
    return Sql("SELECT count(*) FROM pg_stat_activity WHERE datname = "
               "current_database() AND wait_event = 'SyncRep'") == "1\n";
  }));
  const Answer<absl::Status> appended;
  AppendBatch(*a, key, One(1), std::nullopt, appended.Setter());
  const std::string waiting =
      "SELECT count(*) FROM pg_stat_activity WHERE wait_event = 'SyncRep' "
      "AND query LIKE '%INSERT INTO batches%'";
  ASSERT_TRUE(Eventually([&] { return Sql(waiting) == "1\n"; }));
  EXPECT_FALSE(appended.IsSet());
  EXPECT_EQ(Sql("SELECT durable_sequence FROM heads"), "0\n");
  Sql("SELECT pg_cancel_backend(pid) FROM pg_stat_activity WHERE wait_event = "
      "'SyncRep' AND query LIKE '%INSERT INTO batches%'");
  EXPECT_THAT(appended.Get(),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                      HasSubstr("synchronous replication")));
  EXPECT_THAT(a->CheckOwned(key), kFenced);
  // It is there all the same, which taking the vehicle shows.
  EXPECT_EQ(Sql("SELECT durable_sequence FROM heads"), "1\n");
  standbys.Reset();
  ASSERT_TRUE(Eventually([&] { return a->TakeVehicle("truck").ok(); }));
  EXPECT_EQ(a->GetVehicle("truck")->durable_sequence, 1u);
  EXPECT_THAT(BlockingWrites(a.get()).Append(key, One(2)), IsOk());
}

TEST_F(OwnershipTest, ReportsWhatTheDatabaseSaysOfItsCommits) {
  const auto a = Open("a");
  EXPECT_EQ(a->GetDurability().level, Durability::Level::kNone);
  EXPECT_THAT(a->GetDurability().details, HasSubstr("fsync=off"));
  ServerSetting fsync(Server(), "fsync", "on");
  EXPECT_TRUE(Eventually(
      [&] { return a->GetDurability().level == Durability::Level::kLocal; }));
  fsync.Reset();
  EXPECT_TRUE(Eventually(
      [&] { return a->GetDurability().level == Durability::Level::kNone; }));
}

TEST_F(OwnershipTest, TellsHowLongTheDatabaseTakesToCommit) {
  const auto a = Open("a");
  const auto slow_commits = [&] {
    const HistogramCounts flushes = a->Counts().flush_seconds;
    std::uint64_t slow = 0;
    for (std::size_t i = 0; i + 1 < flushes.counts.size(); ++i) {
      if (flushes.bounds[i] > 0.3) slow += flushes.counts[i];
    }
    return slow;
  };
  EXPECT_TRUE(
      Eventually([&] { return !a->Counts().flush_seconds.counts.empty(); }));
  const std::uint64_t before = slow_commits();
  // Runs with the commit, as a flush does.
  Sql("CREATE FUNCTION wait() RETURNS trigger LANGUAGE plpgsql AS "
      "'BEGIN PERFORM pg_sleep(0.3); RETURN NULL; END'");
  Sql("CREATE CONSTRAINT TRIGGER slow AFTER UPDATE ON servers "
      "DEFERRABLE INITIALLY DEFERRED FOR EACH ROW EXECUTE FUNCTION wait()");
  EXPECT_TRUE(Eventually([&] { return slow_commits() > before + 1; }));
}

TEST_F(OwnershipTest, WhatIsRequiredToBeReplicatedIsNotWrittenElsewhere) {
  PostgresOptions options;
  options.require_replicated = true;
  EXPECT_THAT(OpenPostgresStorage(conninfo_, options),
              IsError(StatusCode::kFailedPrecondition, "STORE_UNAVAILABLE",
                      HasSubstr("synchronous_standby_names=''")));
}

TEST_F(OwnershipTest, HeadThatIsBehindWhatWasAcknowledgedEndsTheClaim) {
  const auto a = Open("a");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  for (std::uint64_t i = 1; i <= 3; ++i) {
    ASSERT_THAT(BlockingWrites(a.get()).Append(key, One(i)), IsOk());
  }
  // As after a failover to a standby that lacked the last commit.
  Sql("UPDATE heads SET durable_sequence = 2, revision = 3; "
      "DELETE FROM batches WHERE first_sequence = 3");
  EXPECT_THAT(BlockingWrites(a.get()).Append(key, One(4)), kFenced);
  const auto taken = a->TakeVehicle("truck");
  ASSERT_THAT(taken, IsOk());
  EXPECT_EQ(taken->durable_sequence, 2u);
}

TEST_F(OwnershipTest,
       ClaimsThatAFailoverHasLostAreFoundWhenTheConnectionIsAnother) {
  const auto a = Open("a");
  const VehicleKey key = *BlockingWrites(a.get()).Create("truck");
  Sql("UPDATE heads SET owner = NULL, epoch = 0");
  EndSessions();
  EXPECT_TRUE(Eventually([&] { return !a->CheckOwned(key).ok(); }));
  EXPECT_THAT(a->CheckOwned(key), kFenced);
}

TEST_F(OwnershipTest,
       ClaimsWhoseLastWriteIsLostAreFoundWhenTheConnectionIsAnother) {
  const auto a = Open("a");
  const VehicleKey lost = Prepare(a.get(), "lost");
  const VehicleKey kept = Prepare(a.get(), "kept");
  Sql("UPDATE heads SET revision = 3 WHERE key = " + std::to_string(lost));
  EndSessions();
  EXPECT_TRUE(Eventually([&] { return !a->CheckOwned(lost).ok(); }));
  EXPECT_THAT(a->CheckOwned(lost), kFenced);
  EXPECT_THAT(a->CheckOwned(kept), IsOk());
}

TEST_F(OwnershipTest, AllClaimsEndWhereTheDatabaseIsAnotherOrDoesNotTell) {
  // Found before the function of that name that the system has.
  Sql("ALTER DATABASE " + Sql("SELECT current_database()") +
      " SET search_path = public, pg_catalog");
  const auto be = [this](const std::string& database) {
    Sql("CREATE OR REPLACE FUNCTION pg_control_system(OUT system_identifier "
        "bigint) LANGUAGE sql AS 'SELECT " +
        database + "::bigint'");
  };
  be("1");
  const auto a = Open("a");
  const VehicleKey key = Prepare(a.get(), "truck");
  std::int64_t epoch = 1;
  // A session that ends does not make another database of it.
  EndSessions();
  const std::int64_t beats = BeatsOf("a");
  EXPECT_TRUE(Eventually([&] { return BeatsOf("a") > beats + 2; }));
  EXPECT_THAT(a->CheckOwned(key), IsOk());
  for (const char* const database : {"2", "1/(SELECT 0)", "2"}) {
    SCOPED_TRACE(database);
    be(database);
    EndSessions();
    EXPECT_TRUE(Eventually([&] { return !a->CheckOwned(key).ok(); }));
    EXPECT_THAT(a->CheckOwned(key), kFenced);
    absl::StatusOr<VehicleRecord> taken;
    // The connections that read may have to be made anew.
    ASSERT_TRUE(Eventually([&] {
      taken = a->TakeVehicle("truck");
      return taken.ok();
    }));
    // Nobody else has had it.
    EXPECT_EQ(taken->previous_epoch, epoch);
    epoch = taken->epoch;
  }
}

TEST_F(OwnershipTest, VehicleSaysWhetherSomebodyElseHadItSince) {
  const auto a = Open("a");
  const auto b = Open("b");
  Prepare(a.get(), "truck");
  EXPECT_EQ(a->TakeVehicle("truck")->previous_epoch, 1);
  Bury("a");
  // It joins under another identity.
  ASSERT_TRUE(Eventually([&] {
    return Sql("SELECT count(*) FROM servers WHERE address = 'a'") == "2\n";
  }));
  absl::StatusOr<VehicleRecord> back;
  const auto comes_back = [&] {
    back = a->TakeVehicle("truck");
    return back.ok();
  };
  // The database knows of the new identity before the server does.
  ASSERT_TRUE(Eventually(comes_back));
  EXPECT_EQ(back->previous_epoch, 2);
  Bury("a");
  ASSERT_THAT(b->TakeVehicle("truck"), IsOk());
  EXPECT_EQ(b->TakeVehicle("truck")->previous_epoch, 4);
  Bury("b");
  ASSERT_TRUE(Eventually(comes_back));
  EXPECT_EQ(back->epoch, 6);
  EXPECT_EQ(back->previous_epoch, 0);
}

// The memory of a vehicle that the database had lost would go to the vehicle
// that gets its key.
TEST_F(OwnershipTest, KeyThatIsKnownHereIsNotGivenAgain) {
  const auto a = Open("a");
  BlockingWrites write(a.get());
  const VehicleKey lost = *write.Create("lost");
  Sql("DELETE FROM heads; DELETE FROM vehicles; SELECT setval("
      "pg_get_serial_sequence('vehicles', 'key')::regclass, " +
      std::to_string(lost) + ", false)");
  EXPECT_GT(*write.Create("other"), lost);
  EXPECT_THAT(write.Append(lost, One(1)), kFenced);
  EXPECT_THAT(a->TakeVehicle("lost"),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
}

TEST_F(OwnershipTest, SeveralServersDoTogetherWhatTheModelDoes) {
  std::mt19937_64 random = SeededRandom();
  MemoryStorage model;
  BlockingWrites in_model(&model);
  const std::vector<std::string> ids = {"a", "b", "c"};
  std::map<std::string, std::pair<VehicleKey, VehicleKey>> keys;
  std::vector<std::unique_ptr<Storage>> servers;
  const auto reopen = [&](std::size_t i) {
    servers[i] = Open("server-" + std::to_string(i));
  };
  servers.resize(3);
  for (std::size_t i = 0; i < servers.size(); ++i) reopen(i);
  for (const std::string& id : ids) {
    keys[id] = {*BlockingWrites(servers[0].get()).Create(id),
                *in_model.Create(id)};
  }
  int written = 0;
  int refused = 0;
  for (int step = 0; step < 600; ++step) {
    SCOPED_TRACE("step " + std::to_string(step));
    const auto i = static_cast<std::size_t>(UniformInt(random, 0, 2));
    const std::string id =
        ids[static_cast<std::size_t>(UniformInt(random, 0, 2))];
    Storage& server = *servers[i];
    const auto [key, model_key] = keys[id];
    const std::uint64_t next = model.GetVehicle(id)->durable_sequence + 1;
    const auto revision = static_cast<std::uint64_t>(step) + 2;
    absl::Status status;
    switch (UniformInt(random, 0, 11)) {
      case 0:
        Bury("server-" + std::to_string(i));
        continue;
      case 1:
        reopen(i);
        continue;
      case 2:
        server.ReleaseVehicle(key);
        continue;
      case 3:
      case 4:
      case 5: {
        const auto taken = server.TakeVehicle(id);
        if (taken.ok()) {
          ASSERT_EQ(taken->durable_sequence + 1, next);
        }
        continue;
      }
      case 6:
        status =
            BlockingWrites(&server).Update(key, std::to_string(step), revision);
        if (status.ok()) {
          ASSERT_THAT(
              in_model.Update(model_key, std::to_string(step), revision),
              IsOk());
        }
        break;
      case 7: {
        const PosePairRecord pair{std::to_string(step), 2, 1, step};
        status = BlockingWrites(&server).AddPair(key, PairKind::kLoopClosure,
                                                 pair, revision);
        if (status.ok()) {
          ASSERT_THAT(in_model.AddPair(model_key, PairKind::kLoopClosure, pair,
                                       revision),
                      IsOk());
        }
        break;
      }
      default: {
        const BatchRecord batch{next, 2, revision, std::to_string(step)};
        status = BlockingWrites(&server).Append(key, batch);
        if (status.ok()) {
          ASSERT_THAT(in_model.Append(model_key, batch), IsOk());
        }
        break;
      }
    }
    (status.ok() ? written : refused) += 1;
    if (!status.ok()) {
      ASSERT_THAT(status, kFenced);
    }
    const std::uint64_t end = model.GetVehicle(id)->durable_sequence;
    VehicleRecord real = *servers[0]->GetVehicle(id);
    real.key = model_key;
    ASSERT_EQ(ToText(real), ToText(*model.GetVehicle(id)));
    if (end > 0) {
      ASSERT_EQ(ToTexts(*ReadAll(*servers[0], key, 1, end)),
                ToTexts(*ReadAll(model, model_key, 1, end)));
    }
  }
  EXPECT_GT(written, 50);
  EXPECT_GT(refused, 50);
}

}  // namespace
}  // namespace revisit::server
