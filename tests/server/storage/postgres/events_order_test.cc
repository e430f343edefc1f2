// That nothing comes to stand before what ReadEvents() has answered, whatever
// commits wait for.
#include <atomic>
#include <cstdint>
#include <iostream>
#include <map>
#include <memory>
#include <random>
#include <string>
#include <thread>
#include <tuple>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/storage/postgres/postgres_storage.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage/postgres/postgres_server.h"
#include "tests/server/storage_testing.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

// The commit of a transaction with events of a vehicle waits while somebody
// else has the lock of the vehicle's key, as one waits for a standby.
constexpr char kCommitsWait[] =
    "CREATE FUNCTION wait() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN "
    "PERFORM pg_advisory_xact_lock_shared(NEW.vehicle_key); RETURN NULL; "
    "END $$; CREATE CONSTRAINT TRIGGER wait AFTER INSERT ON events "
    "DEFERRABLE INITIALLY DEFERRED FOR EACH ROW EXECUTE FUNCTION wait()";

constexpr int kVehicles = 4;
// How often a commit, or a transaction without events, is held up.
constexpr int kHolds = 12;
// Events that the control reads meanwhile: more than can have been under way
// when the hold began, so that some are of later transactions.
constexpr std::size_t kEventsPassed = 3 * kVehicles;

std::unique_ptr<PostgresConnection> Connect(const std::string& conninfo) {
  PostgresConnection::Options options;
  options.conninfo = conninfo;
  return *PostgresConnection::Open(options);
}

// A reader that takes what is committed for all that comes: its cursor moves
// behind the last event that it sees.
class HastyReader {
 public:
  explicit HastyReader(const std::string& conninfo)
      : connection_(Connect(conninfo)) {}

  void Read() {
    constexpr Statement kRead = {
        "read_hastily",
        "SELECT xid, vehicle_key, number FROM events WHERE (xid, vehicle_key, "
        "number) > ($1::xid8, $2::int8, $3::int8) "
        "ORDER BY xid, vehicle_key, number"};
    const auto rows = connection_->Run(kRead, Parameters()
                                                  .Add(std::get<0>(cursor_))
                                                  .Add(std::get<1>(cursor_))
                                                  .Add(std::get<2>(cursor_)));
    ASSERT_THAT(rows, IsOk());
    for (int i = 0; i < rows->size(); ++i) {
      cursor_ = {rows->Integer(i, 0), rows->Integer(i, 1), rows->Integer(i, 2)};
      ++count_;
    }
  }

  std::size_t count() const { return count_; }

 private:
  const std::unique_ptr<PostgresConnection> connection_;
  std::tuple<std::int64_t, std::int64_t, std::int64_t> cursor_ = {0, 0, 0};
  std::atomic<std::size_t> count_{0};
};

class EventsOrderTest : public ::testing::Test {
 protected:
  void SetUp() override {
    if (PostgresServer::Shared() == nullptr) {
      GTEST_SKIP() << "PostgreSQL's server programs are not installed";
    }
    conninfo_ = PostgresServer::Shared()->MakeStore();
    PostgresServer::Shared()->Run(conninfo_, kCommitsWait);
    PostgresOptions options;
    // Each vehicle has its own connection, so that one that waits holds no
    // other up.
    options.writer_connections = kVehicles;
    auto opened = OpenPostgresStorage(conninfo_, options);
    ASSERT_THAT(opened, IsOk());
    storage_ = *std::move(opened);
    connection_ = Connect(conninfo_);
    for (int i = 0; i < kVehicles; ++i) {
      keys_.push_back(
          *BlockingWrites(storage_.get()).Create("v" + std::to_string(i)));
    }
  }

  // Puts checks and adds and deletes pairs, each with events, until the test
  // stops. A write that waited for too long is settled first.
  void Write(int vehicle, std::uint32_t seed) {
    std::mt19937_64 random(seed);
    BlockingWrites write(storage_.get());
    std::uint64_t revision = 1;
    while (!stop_) {
      const auto taken = storage_->TakeVehicle("v" + std::to_string(vehicle));
      ASSERT_THAT(taken, IsOk());
      const VehicleKey key = taken->key;
      ChecksHead head = taken->checks;
      bool has_pair = taken->loop_closure_count > 0;
      absl::Status status;
      while (!stop_ && status.ok()) {
        ChecksWrite checks;
        checks.before = head;
        checks.after = head;
        checks.after.stores = true;
        for (int i = UniformInt(random, 1, 3); i > 0; --i) {
          EventRecord event;
          event.payload = std::to_string(++checks.after.last_event);
          checks.events.push_back(std::move(event));
        }
        DeletedPairRecord deleted;
        deleted.pair = {"p", 2, 1, 0};
        ++revision;
        if (UniformInt(random, 0, 1) == 0) {
          status = write.PutChecks(key, checks);
        } else if (has_pair) {
          status = write.DeletePair(key, deleted, revision, checks);
          has_pair = false;
        } else {
          status =
              write.AddPair(key, deleted.kind, deleted.pair, revision, checks);
          has_pair = true;
        }
        head = checks.after;
      }
      EXPECT_TRUE(status.ok() || absl::IsUnavailable(status)) << status;
    }
  }

  // Reads all events, with cursors that it keeps, until there are no more.
  void Follow(std::uint32_t seed, std::map<VehicleKey, std::uint64_t>* last) {
    std::mt19937_64 random(seed);
    EventPosition cursor;
    while (true) {
      const bool all_are_told = all_are_told_;
      const auto events =
          storage_->ReadEvents(cursor, UniformInt(random, 1, 20));
      ASSERT_THAT(events, IsOk());
      for (const EventRecord& event : *events) {
        ASSERT_EQ(event.number, (*last)[event.position.key] + 1)
            << "of vehicle " << event.position.key;
        ASSERT_THAT(event.damage, IsOk());
        ASSERT_EQ(event.payload, std::to_string(event.number));
        (*last)[event.position.key] = event.number;
        cursor = event.position;
      }
      if (events->empty() && all_are_told) return;
      if (events->empty()) std::this_thread::yield();
    }
  }

  bool Query(const char* name, const char* sql) {
    const auto rows = connection_->Run({name, sql});
    EXPECT_THAT(rows, IsOk());
    return rows.ok() && rows->Integer(0, 0) != 0;
  }

  std::string conninfo_;
  std::unique_ptr<Storage> storage_;
  std::unique_ptr<PostgresConnection> connection_;
  std::vector<VehicleKey> keys_;
  std::atomic<bool> stop_{false};
  std::atomic<bool> all_are_told_{false};
};

TEST_F(EventsOrderTest, WhoKeepsACursorMissesNoEventWhateverCommitsWaitFor) {
  std::mt19937_64 random = SeededRandom();
  std::vector<std::thread> writers;
  for (int i = 0; i < kVehicles; ++i) {
    writers.emplace_back(
        [this, i, seed = static_cast<std::uint32_t>(random())] {
          Write(i, seed);
        });
  }
  std::vector<std::map<VehicleKey, std::uint64_t>> read(2);
  std::vector<std::thread> readers;
  for (auto& last : read) {
    readers.emplace_back(
        [this, &last, seed = static_cast<std::uint32_t>(random())] {
          Follow(seed, &last);
        });
  }
  HastyReader hasty(conninfo_);
  const auto others_go_on = [&] {
    const std::size_t before = hasty.count();
    EXPECT_TRUE(Eventually([&] {
      hasty.Read();
      return hasty.count() >= before + kEventsPassed;
    }));
  };
  const auto client = Connect(conninfo_);
  for (int i = 0; i < kHolds; ++i) {
    if (i % 3 == 2) {
      // A transaction that has written, but no events.
      ASSERT_THAT(client->RunText("BEGIN; SELECT pg_current_xact_id()"),
                  IsOk());
      others_go_on();
      ASSERT_THAT(client->RunText("COMMIT"), IsOk());
      continue;
    }
    const std::string key = std::to_string(
        keys_[static_cast<std::size_t>(UniformInt(random, 0, kVehicles - 1))]);
    // The writer may have the lock for the moment of a commit.
    EXPECT_TRUE(Eventually([&] {
      return client->RunText("SELECT pg_advisory_lock(" + key + ")").ok();
    }));
    EXPECT_TRUE(Eventually([&] {
      return Query("commit_waits",
                   "SELECT EXISTS (SELECT 1 FROM pg_locks WHERE locktype = "
                   "'advisory' AND NOT granted)");
    }));
    others_go_on();
    ASSERT_THAT(client->RunText("SELECT pg_advisory_unlock(" + key + ")"),
                IsOk());
  }
  stop_ = true;
  for (std::thread& writer : writers) writer.join();
  EXPECT_TRUE(Eventually([&] {
    return Query("all_are_told",
                 "SELECT NOT EXISTS (SELECT 1 FROM events WHERE xid >= "
                 "pg_snapshot_xmin(pg_current_snapshot()))");
  }));
  all_are_told_ = true;
  for (std::thread& reader : readers) reader.join();
  hasty.Read();
  std::map<VehicleKey, std::uint64_t> written;
  std::size_t total = 0;
  const auto vehicles = storage_->ListVehicles("", "", 99);
  ASSERT_THAT(vehicles, IsOk());
  for (const VehicleRecord& record : *vehicles) {
    EXPECT_THAT(record.damage, IsOk());
    written[record.key] = record.checks.last_event;
    total += record.checks.last_event;
  }
  for (const auto& last : read) EXPECT_EQ(last, written);
  // The control: the commits that waited did come in between.
  EXPECT_LT(hasty.count(), total);
  std::cout << total << " events, of which a hasty reader missed "
            << total - hasty.count() << "\n";
}

}  // namespace
}  // namespace revisit::server
