#include "server/sessions/fleet.h"

#include <atomic>
#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <random>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "core/settings.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "server/storage/sqlite/sqlite_storage.h"
#include "server/storage/sqlite/store_check.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/held_storage.h"
#include "tests/server/memory_storage.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/storage_testing.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using std::chrono::minutes;
using std::chrono::steady_clock;
using ::testing::_;

absl::StatusOr<Snapshot> CreateNow(Fleet& fleet, const std::string& id) {
  const Answer<absl::StatusOr<Snapshot>> answer;
  fleet.Create(id, TestConfig(), TakingCreated(answer));
  return answer.Get();
}

absl::Status DeleteNow(Fleet& fleet, const std::string& id) {
  const Answer<absl::Status> answer;
  fleet.Delete(id, answer.Setter());
  return answer.Get();
}

class FleetTest : public ::testing::Test {
 protected:
  FleetTest() { MakeFleet(); }
  ~FleetTest() override { storage_.ReleaseAll(); }

  void MakeFleet() {
    fleet_.reset();
    fleet_ = std::make_unique<Fleet>(&storage_, &codec_, &executor_,
                                     Fleet::Options());
  }

  // Waits until no task refers to the vehicle any more, then unloads what was
  // idle for this long.
  void UnloadAfter(const std::string& id, std::chrono::milliseconds idle) {
    std::shared_ptr<VehicleSession> session = fleet_->Session(id);
    AwaitIdle(session, 2);
    session.reset();
    fleet_->UnloadIdle(steady_clock::now() + idle);
  }

  // Until there are but so many references to the session.
  static void AwaitIdle(const std::shared_ptr<VehicleSession>& session,
                        long references) {
    while (session.use_count() > references || session->busy()) {
      std::this_thread::yield();
    }
  }

  MemoryStorage memory_;
  HeldStorage storage_{&memory_};
  PlainCodec codec_;
  Executor executor_{2};
  std::unique_ptr<Fleet> fleet_;
};

const auto kNotFound = IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _);

TEST_F(FleetTest, CreatesVehicleAndAnswersWithIt) {
  const auto created = CreateNow(*fleet_, "truck");
  ASSERT_THAT(created, IsOk());
  EXPECT_EQ(created->revision, 1u);
  EXPECT_EQ(created->durable_sequence, 0u);
  EXPECT_EQ(created->config.drive.node_spacing_meters, 1.0);
  EXPECT_EQ(fleet_->loaded(), 1u);
  EXPECT_EQ(AppendNow(*fleet_->Session("truck"), StraightBatch(1, 2))->revision,
            2u);
}

// A creation whose vehicle is not loaded before `meanwhile` is called with its
// key.
absl::StatusOr<Snapshot> CreateWhile(
    Fleet* fleet, Executor* short_work, MemoryStorage* storage,
    const std::function<void(VehicleKey)>& meanwhile) {
  const Answer<bool> gate;
  short_work->Post([=] { gate.Get(); });
  const Answer<absl::StatusOr<Snapshot>> created;
  fleet->Create("truck", TestConfig(), TakingCreated(created));
  absl::StatusOr<VehicleRecord> stored = storage->GetVehicle("truck");
  while (!stored.ok()) {
    std::this_thread::yield();
    stored = storage->GetVehicle("truck");
  }
  meanwhile(stored->key);
  gate.Set(true);
  return created.Get();
}

// A creation that found nothing was answered NOT_FOUND, which it never is.
TEST_F(FleetTest, AnswersWithTheVehicleThatItCreatedAlsoIfItIsDeletedAtOnce) {
  Executor short_work(1);
  Executor long_work(1);
  Fleet fleet(&storage_, &codec_, Lanes(&short_work, &long_work),
              Fleet::Options());
  const auto created =
      CreateWhile(&fleet, &short_work, &memory_, [&](VehicleKey key) {
        ASSERT_THAT(BlockingWrites(&memory_).Delete(key), IsOk());
      });
  ASSERT_THAT(created, IsOk());
  EXPECT_EQ(created->revision, 1u);
  EXPECT_EQ(created->durable_sequence, 0u);
  EXPECT_EQ(created->config.drive.node_spacing_meters, 1.0);
  EXPECT_THAT(ReadNow(*fleet.Session("truck")), kNotFound);
}

TEST_F(FleetTest, AnswersWithTheVehicleAsItCreatedItAlsoIfOthersChangeIt) {
  Executor short_work(1);
  Executor long_work(1);
  Fleet fleet(&storage_, &codec_, Lanes(&short_work, &long_work),
              Fleet::Options());
  const auto created =
      CreateWhile(&fleet, &short_work, &memory_, [&](VehicleKey key) {
        ASSERT_THAT(BlockingWrites(&memory_).Append(
                        key, {1, 2, 2, StraightBatch(1, 2)}),
                    IsOk());
      });
  ASSERT_THAT(created, IsOk());
  EXPECT_EQ(created->revision, 1u);
  EXPECT_EQ(created->durable_sequence, 0u);
  EXPECT_EQ(created->node_count, 0);
  EXPECT_EQ(ReadNow(*fleet.Session("truck"))->durable_sequence, 2u);
}

TEST_F(FleetTest, OthersAreAcknowledgedWhileOneVehicleSearches) {
  Executor short_work(1);
  Executor long_work(1);
  Fleet fleet(&storage_, &codec_, Lanes(&short_work, &long_work),
              Fleet::Options());
  ASSERT_THAT(CreateNow(fleet, "searching"), IsOk());
  ASSERT_THAT(CreateNow(fleet, "other"), IsOk());
  const Answer<bool> started;
  const Answer<bool> gate;
  fleet.Session("searching")->LongRead([=](const absl::StatusOr<VehicleView>&) {
    started.Set(true);
    gate.Get();
  });
  started.Get();
  for (std::uint64_t i = 1; i <= 20; ++i) {
    EXPECT_EQ(AppendNow(*fleet.Session("other"), StraightBatch(i, 1))
                  ->durable_sequence,
              i);
  }
  EXPECT_EQ(ReadNow(*fleet.Session("other"))->durable_sequence, 20u);
  // Its own poses wait until the search is over, and are not lost.
  const Appended own = Append(*fleet.Session("searching"), StraightBatch(1, 1));
  EXPECT_FALSE(own.durable.IsSet());
  gate.Set(true);
  EXPECT_EQ(own.durable.Get()->durable_sequence, 1u);
}

TEST_F(FleetTest, RefusesSecondVehicleOfOneId) {
  ASSERT_THAT(CreateNow(*fleet_, "truck"), IsOk());
  EXPECT_THAT(CreateNow(*fleet_, "truck"),
              IsError(StatusCode::kAlreadyExists, "VEHICLE_EXISTS", _));
}

TEST_F(FleetTest, CreatesVehicleThatWasAskedForBefore) {
  const std::shared_ptr<VehicleSession> before = fleet_->Session("truck");
  EXPECT_THAT(ReadNow(*before), kNotFound);
  ASSERT_THAT(CreateNow(*fleet_, "truck"), IsOk());
  EXPECT_THAT(ReadNow(*fleet_->Session("truck")), IsOk());
  EXPECT_THAT(ReadNow(*before), kNotFound);
}

TEST_F(FleetTest, CreatesVehiclesThatAreAskedForMeanwhile) {
  // Whoever asks while a vehicle is being created finds it or not; whoever
  // created it always does.
  std::atomic<bool> stop{false};
  std::thread asker([&] {
    while (!stop) {
      for (int i = 0; i < 50; ++i) {
        fleet_->Session("vehicle-" + std::to_string(i));
      }
    }
  });
  for (int i = 0; i < 50; ++i) {
    EXPECT_THAT(CreateNow(*fleet_, "vehicle-" + std::to_string(i)), IsOk());
  }
  stop = true;
  asker.join();
}

TEST_F(FleetTest, DeletesVehicle) {
  EXPECT_THAT(DeleteNow(*fleet_, "truck"), kNotFound);
  ASSERT_THAT(CreateNow(*fleet_, "truck"), IsOk());
  const std::shared_ptr<VehicleSession> old = fleet_->Session("truck");
  ASSERT_THAT(AppendNow(*old, StraightBatch(1, 2)), IsOk());
  ASSERT_THAT(DeleteNow(*fleet_, "truck"), IsOk());
  EXPECT_EQ(fleet_->loaded(), 0u);
  EXPECT_THAT(DeleteNow(*fleet_, "truck"), kNotFound);
  // A new one of that name has nothing of the old.
  ASSERT_THAT(CreateNow(*fleet_, "truck"), IsOk());
  EXPECT_EQ(ReadNow(*fleet_->Session("truck"))->durable_sequence, 0u);
  EXPECT_THAT(ReadNow(*old), kNotFound);
}

TEST_F(FleetTest, SharesSessionOfVehicle) {
  ASSERT_THAT(CreateNow(*fleet_, "truck"), IsOk());
  EXPECT_EQ(fleet_->Session("truck"), fleet_->Session("truck"));
}

TEST_F(FleetTest, UnknownVehiclesTakeNoRoom) {
  for (int i = 0; i < 100; ++i) {
    EXPECT_THAT(ReadNow(*fleet_->Session("ghost-" + std::to_string(i))),
                kNotFound);
  }
  EXPECT_EQ(fleet_->loaded(), 0u);
}

TEST_F(FleetTest, LoadsAnewAfterTheStoreFailed) {
  ASSERT_THAT(CreateNow(*fleet_, "truck"), IsOk());
  MakeFleet();
  storage_.FailReads(
      Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE", "broken"));
  EXPECT_THAT(ReadNow(*fleet_->Session("truck")),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE", "broken"));
  storage_.FailReads(absl::OkStatus());
  EXPECT_THAT(ReadNow(*fleet_->Session("truck")), IsOk());
}

TEST_F(FleetTest, UnloadsIdleVehicleAndLoadsItAgain) {
  ASSERT_THAT(CreateNow(*fleet_, "truck"), IsOk());
  ASSERT_THAT(AppendNow(*fleet_->Session("truck"), StraightBatch(1, 9)),
              IsOk());
  UnloadAfter("truck", minutes(9));
  EXPECT_EQ(fleet_->loaded(), 1u);
  UnloadAfter("truck", minutes(11));
  EXPECT_EQ(fleet_->loaded(), 0u);
  const auto read = ReadNow(*fleet_->Session("truck"));
  EXPECT_EQ(read->durable_sequence, 9u);
  EXPECT_EQ(read->node_count, 9);
  EXPECT_EQ(fleet_->loaded(), 1u);
}

TEST_F(FleetTest, KeepsVehicleThatSomeoneHolds) {
  ASSERT_THAT(CreateNow(*fleet_, "truck"), IsOk());
  std::shared_ptr<VehicleSession> held = fleet_->Session("truck");
  AwaitIdle(held, 2);
  fleet_->UnloadIdle(steady_clock::now() + minutes(11));
  EXPECT_EQ(fleet_->loaded(), 1u);
  // It was in use until then.
  held.reset();
  fleet_->UnloadIdle(steady_clock::now() + minutes(20));
  EXPECT_EQ(fleet_->loaded(), 1u);
  fleet_->UnloadIdle(steady_clock::now() + minutes(22));
  EXPECT_EQ(fleet_->loaded(), 0u);
}

TEST_F(FleetTest, KeepsVehicleWithWorkInFlight) {
  ASSERT_THAT(CreateNow(*fleet_, "truck"), IsOk());
  storage_.Hold();
  const Appended appended =
      Append(*fleet_->Session("truck"), StraightBatch(1, 1));
  storage_.Await(1);
  fleet_->UnloadIdle(steady_clock::now() + minutes(11));
  EXPECT_EQ(fleet_->loaded(), 1u);
  storage_.ReleaseAll();
  EXPECT_THAT(appended.durable.Get(), IsOk());
}

TEST_F(FleetTest, TellsWhatIsInMemory) {
  ASSERT_THAT(CreateNow(*fleet_, "truck"), IsOk());
  ASSERT_THAT(CreateNow(*fleet_, "car"), IsOk());
  ASSERT_THAT(AppendNow(*fleet_->Session("truck"), StraightBatch(1, 9)),
              IsOk());
  const Fleet::Residency both = fleet_->residency();
  EXPECT_EQ(both.vehicles, 2);
  EXPECT_EQ(both.nodes, 9);
  EXPECT_GE(both.bytes, 9 * 72);
  EXPECT_LE(both.bytes, 10000);
  // The same once it was loaded from the store.
  MakeFleet();
  EXPECT_EQ(fleet_->residency().nodes, 0);
  ASSERT_THAT(ReadNow(*fleet_->Session("truck")), IsOk());
  EXPECT_EQ(fleet_->residency().vehicles, 1);
  EXPECT_EQ(fleet_->residency().nodes, 9);
  EXPECT_EQ(fleet_->residency().bytes, both.bytes);
}

TEST_F(FleetTest, UnloadsTheLongestUnusedAboveItsBudget) {
  constexpr int kVehicles = 6;
  const auto id = [](int i) { return "vehicle-" + std::to_string(i); };
  for (int i = 0; i < kVehicles; ++i) {
    ASSERT_THAT(CreateNow(*fleet_, id(i)), IsOk());
    ASSERT_THAT(AppendNow(*fleet_->Session(id(i)), StraightBatch(1, 40)),
                IsOk());
  }
  const std::int64_t all = fleet_->residency().bytes;
  Fleet::Options options;
  options.memory_budget_bytes = all / 2;
  fleet_.reset();
  fleet_ = std::make_unique<Fleet>(&storage_, &codec_, &executor_, options);
  // The first is held, so it stays although it is the longest unused.
  const std::shared_ptr<VehicleSession> held = fleet_->Session(id(0));
  for (int i = 0; i < kVehicles; ++i) {
    std::shared_ptr<VehicleSession> session = fleet_->Session(id(i));
    ASSERT_THAT(ReadNow(*session), IsOk());
    AwaitIdle(session, i == 0 ? 3 : 2);
  }
  EXPECT_EQ(fleet_->residency().bytes, all);
  const Fleet::Residency gone = fleet_->UnloadIdle(steady_clock::now());
  EXPECT_EQ(gone.vehicles, 3);
  EXPECT_EQ(gone.bytes, all / 2);
  EXPECT_EQ(fleet_->residency().bytes, all / 2);
  EXPECT_NE(fleet_->SessionIfLoaded(id(0)), nullptr);
  for (const int i : {1, 2, 3}) {
    EXPECT_EQ(fleet_->SessionIfLoaded(id(i)), nullptr) << i;
  }
  for (const int i : {4, 5}) {
    EXPECT_NE(fleet_->SessionIfLoaded(id(i)), nullptr) << i;
  }
  // What went is there when it is asked for.
  EXPECT_EQ(ReadNow(*fleet_->Session(id(2)))->durable_sequence, 40u);
}

TEST_F(FleetTest, DestructorFinishesWhatWasCalled) {
  ASSERT_THAT(CreateNow(*fleet_, "truck"), IsOk());
  storage_.Hold();
  const Appended appended =
      Append(*fleet_->Session("truck"), StraightBatch(1, 1));
  const Answer<absl::StatusOr<Snapshot>> created;
  fleet_->Create("car", TestConfig(), TakingCreated(created));
  storage_.Await(2);
  std::thread destroyer([&] {
    fleet_.reset();
    EXPECT_TRUE(appended.durable.IsSet());
    EXPECT_TRUE(created.IsSet());
  });
  storage_.ReleaseAll();
  destroyer.join();
  EXPECT_THAT(appended.durable.Get(), IsOk());
  EXPECT_THAT(created.Get(), IsOk());
}

TEST_F(FleetTest, CreateThatFailsSaysWhy) {
  storage_.Hold();
  const Answer<absl::StatusOr<Snapshot>> created;
  fleet_->Create("car", TestConfig(), TakingCreated(created));
  storage_.FailOne(
      Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE", "broken"));
  EXPECT_THAT(created.Get(),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE", "broken"));
}

TEST(FleetStressTest, ManyClientsVehiclesAndUnloadsLoseNothing) {
  std::mt19937_64 random = SeededRandom();
  constexpr int kClients = 4;
  constexpr int kVehicles = 6;
  constexpr std::uint64_t kBatches = 40;
  const TemporaryDirectory directory;
  const PlainCodec codec;
  const std::string path = directory.File("store.db");
  std::vector<std::string> graphs;
  for (int opening = 0; opening < 2; ++opening) {
    absl::StatusOr<std::unique_ptr<Storage>> storage = OpenSqliteStorage(path);
    ASSERT_THAT(storage, IsOk());
    Executor executor(3);
    Fleet fleet(storage->get(), &codec, &executor, Fleet::Options());
    const auto id = [](int i) { return "vehicle-" + std::to_string(i); };
    if (opening == 1) {
      for (int i = 0; i < kVehicles; ++i) {
        EXPECT_EQ(ReadNow(*fleet.Session(id(i)))->graph,
                  graphs[static_cast<std::size_t>(i)]);
      }
      break;
    }
    for (int i = 0; i < kVehicles; ++i) {
      ASSERT_THAT(CreateNow(fleet, id(i)), IsOk());
    }
    std::atomic<bool> stop{false};
    std::thread unloader([&] {
      while (!stop) fleet.UnloadIdle(steady_clock::now() + minutes(11));
    });
    std::vector<std::thread> clients;
    for (int c = 0; c < kClients; ++c) {
      clients.emplace_back([&, c, seed = random()] {
        std::mt19937_64 own(seed);
        // Every vehicle by two clients, which send the same.
        for (std::uint64_t batch = 0; batch < kBatches; ++batch) {
          for (int i = c % 2; i < kVehicles; i += 2) {
            const auto ack =
                AppendNow(*fleet.Session(id(i)), SquareBatch(5 * batch + 1, 5));
            EXPECT_THAT(ack, IsOk());
            if (UniformInt(own, 0, 3) == 0) {
              EXPECT_THAT(ReadNow(*fleet.Session(id(i))), IsOk());
            }
          }
        }
      });
    }
    for (std::thread& client : clients) client.join();
    stop = true;
    unloader.join();
    for (int i = 0; i < kVehicles; ++i) {
      const absl::StatusOr<Snapshot> read = ReadNow(*fleet.Session(id(i)));
      ASSERT_THAT(read, IsOk());
      EXPECT_EQ(read->durable_sequence, 5 * kBatches);
      EXPECT_EQ(read->revision, 1 + kBatches);
      graphs.push_back(read->graph);
    }
  }
}

// One drive of a vehicle that nobody else writes to: batches with checks, loop
// closures that are added and taken back.
class Driver {
 public:
  static constexpr std::uint64_t kBatchPoses = 10;
  static constexpr std::uint64_t kBatches = 16;

  Driver(Fleet* fleet, std::string id) : fleet_(fleet), id_(std::move(id)) {}

  // The last sequence that was acknowledged.
  std::uint64_t acknowledged() const { return acknowledged_; }
  std::uint64_t revision() const { return revision_; }
  // The answers of all checks, in their order.
  const std::string& found() const { return found_; }

  void Drive() {
    for (std::uint64_t batch = 0; batch < kBatches; ++batch) {
      AppendOne();
      // Whoever was acknowledged finds it.
      const absl::StatusOr<Snapshot> read = ReadNow(*fleet_->Session(id_));
      ASSERT_THAT(read, IsOk());
      EXPECT_EQ(read->durable_sequence, acknowledged_);
      EXPECT_EQ(read->revision, revision_);
      if (batch % 3 == 2) AddAndDeleteClosure(batch);
    }
    // An append is acknowledged before its check has run.
    last_append_over_->Get();
  }

 private:
  void AppendOne() {
    const std::string payload = SquareBatch(acknowledged_ + 1, kBatchPoses);
    const Answer<absl::StatusOr<Acknowledgement>> durable;
    const auto append = std::make_shared<PlainAppend>(payload);
    append->durable = durable.Setter();
    append->wants = true;
    last_append_over_.emplace();
    append->over = [over = *last_append_over_] { over.Set(true); };
    append->candidates = [this](const VehicleView& view,
                                const absl::StatusOr<core::CandidateSet>& set) {
      ASSERT_THAT(set, IsOk());
      found_ += std::to_string(view.durable_sequence) + ": node " +
                std::to_string(*set->query);
      for (const core::Candidate& candidate : set->candidates) {
        found_ += " " + std::to_string(candidate.matched);
      }
      found_ += "\n";
    };
    fleet_->Session(id_)->Append(append->Request(), append);
    const absl::StatusOr<Acknowledgement> acknowledgement = durable.Get();
    ASSERT_THAT(acknowledgement, IsOk());
    acknowledged_ += kBatchPoses;
    ++revision_;
    EXPECT_EQ(acknowledgement->durable_sequence, acknowledged_);
    EXPECT_EQ(acknowledgement->revision, revision_);
  }

  void AddAndDeleteClosure(std::uint64_t number) {
    const std::string closure = "closure-" + std::to_string(number);
    const auto added =
        AddPairNow(*fleet_->Session(id_), PairKind::kLoopClosure,
                   {closure, acknowledged_, acknowledged_ / 2, 0});
    ASSERT_THAT(added, IsOk());
    EXPECT_EQ(added->revision, ++revision_);
    if (number % 2 == 0) return;
    const auto deleted =
        DeletePairNow(*fleet_->Session(id_), PairKind::kLoopClosure, closure);
    ASSERT_THAT(deleted, IsOk());
    EXPECT_EQ(*deleted, ++revision_);
  }

  Fleet* const fleet_;
  const std::string id_;
  std::uint64_t acknowledged_ = 0;
  std::uint64_t revision_ = 1;
  std::string found_;
  std::optional<Answer<bool>> last_append_over_;
};

// Creates, fills and deletes a vehicle again and again.
void CreateAndDelete(Fleet* fleet, const std::string& id,
                     std::mt19937_64 random) {
  for (int round = 0; round < 12; ++round) {
    ASSERT_THAT(CreateNow(*fleet, id), IsOk());
    const int batches = UniformInt(random, 0, 3);
    for (int i = 0; i < batches; ++i) {
      const auto first = static_cast<std::uint64_t>(5 * i + 1);
      ASSERT_THAT(AppendNow(*fleet->Session(id), StraightBatch(first, 5)),
                  IsOk());
    }
    const absl::StatusOr<Snapshot> read = ReadNow(*fleet->Session(id));
    ASSERT_THAT(read, IsOk());
    // Nothing of those of that name before.
    EXPECT_EQ(read->durable_sequence, static_cast<std::uint64_t>(5 * batches));
    EXPECT_EQ(read->revision, static_cast<std::uint64_t>(1 + batches));
    ASSERT_THAT(DeleteNow(*fleet, id), IsOk());
    EXPECT_THAT(ReadNow(*fleet->Session(id)), kNotFound);
  }
}

TEST(FleetStressTest, AllKindsOfWorkAtOnceChangeNoAnswer) {
  // Vehicles are appended to and searched, others come and go, while all are
  // read, searched, listed and unloaded from other threads. What the drivers
  // are answered is what they are answered alone.
  std::mt19937_64 random = SeededRandom();
  constexpr int kDrivers = 3;
  const TemporaryDirectory directory;
  const PlainCodec codec;
  const auto kept = [](int i) { return "kept-" + std::to_string(i); };
  const auto brief = [](int i) { return "brief-" + std::to_string(i); };

  MemoryStorage memory;
  Executor single(1);
  Fleet alone(&memory, &codec, &single, Fleet::Options());
  ASSERT_THAT(CreateNow(alone, kept(0)), IsOk());
  Driver model(&alone, kept(0));
  model.Drive();
  const Snapshot expected = *ReadNow(*alone.Session(kept(0)));

  const absl::StatusOr<std::unique_ptr<Storage>> storage =
      OpenSqliteStorage(directory.File("store.db"));
  ASSERT_THAT(storage, IsOk());
  Executor short_work(2);
  Executor long_work(2);
  const auto fleet = std::make_unique<Fleet>(
      storage->get(), &codec, Lanes(&short_work, &long_work), Fleet::Options());
  std::vector<std::unique_ptr<Driver>> drivers;
  for (int i = 0; i < kDrivers; ++i) {
    ASSERT_THAT(CreateNow(*fleet, kept(i)), IsOk());
    drivers.push_back(std::make_unique<Driver>(fleet.get(), kept(i)));
  }

  std::atomic<bool> stop{false};
  std::vector<std::thread> others;
  for (int i = 0; i < 2; ++i) {
    others.emplace_back([&, seed = random()] {
      std::mt19937_64 own(seed);
      std::vector<std::uint64_t> seen(kDrivers, 0);
      while (!stop) {
        const int vehicle = UniformInt(own, 0, kDrivers - 1);
        const Answer<std::uint64_t> answer;
        fleet->Session(kept(vehicle))
            ->LongRead([&](const absl::StatusOr<VehicleView>& view) {
              EXPECT_THAT(view.status(), IsOk());
              const core::SearchOptions& options = view->config.drive.search;
              EXPECT_THAT(view->search->AtEnd(options, nullptr), IsOk());
              EXPECT_EQ(view->durable_sequence % Driver::kBatchPoses, 0u);
              answer.Set(view->durable_sequence);
            });
        const std::uint64_t sequence = answer.Get();
        std::uint64_t& before = seen[static_cast<std::size_t>(vehicle)];
        EXPECT_GE(sequence, before);
        before = sequence;
        const absl::StatusOr<Snapshot> read =
            ReadNow(*fleet->Session(brief(UniformInt(own, 0, 1))));
        EXPECT_THAT(read, ::testing::AnyOf(IsOk(), kNotFound));
      }
    });
  }
  others.emplace_back([&] {
    while (!stop) {
      fleet->UnloadIdle(steady_clock::now() + minutes(11));
      EXPECT_LE(fleet->loaded(), static_cast<std::size_t>(kDrivers + 2));
      EXPECT_LE(fleet->residency().vehicles, kDrivers + 2);
    }
  });
  others.emplace_back([&] {
    while (!stop) {
      const auto listed = (*storage)->ListVehicles("", "kept-", 100);
      ASSERT_THAT(listed, IsOk());
      EXPECT_EQ(listed->size(), static_cast<std::size_t>(kDrivers));
      const auto batches = ReadAll(**storage, listed->front().key, 1,
                                   listed->front().durable_sequence);
      EXPECT_THAT(batches, IsOk());
      // It once took vehicles for damaged that were deleted meanwhile.
      const auto report =
          CheckStore(directory.File("store.db"), StoreUse::kServed);
      ASSERT_THAT(report, IsOk());
      EXPECT_THAT(report->problems, ::testing::IsEmpty());
    }
  });
  std::vector<std::thread> workers;
  for (const std::unique_ptr<Driver>& driver : drivers) {
    workers.emplace_back([&driver] { driver->Drive(); });
  }
  for (int i = 0; i < 2; ++i) {
    workers.emplace_back([&, i, seed = random()] {
      CreateAndDelete(fleet.get(), brief(i), std::mt19937_64(seed));
    });
  }
  for (std::thread& worker : workers) worker.join();
  stop = true;
  for (std::thread& other : others) other.join();

  for (int i = 0; i < kDrivers; ++i) {
    const absl::StatusOr<Snapshot> read = ReadNow(*fleet->Session(kept(i)));
    ASSERT_THAT(read, IsOk());
    EXPECT_EQ(read->durable_sequence, expected.durable_sequence);
    EXPECT_EQ(read->revision, expected.revision);
    EXPECT_EQ(read->loop_closure_count, expected.loop_closure_count);
    EXPECT_EQ(read->graph, expected.graph);
    EXPECT_EQ(drivers[static_cast<std::size_t>(i)]->found(), model.found());
  }
  const auto left = (*storage)->ListVehicles("", "", 100);
  ASSERT_THAT(left, IsOk());
  EXPECT_EQ(left->size(), static_cast<std::size_t>(kDrivers));
}

}  // namespace
}  // namespace revisit::server
