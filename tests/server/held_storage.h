// A storage whose writes wait, or fail, as a test wants.
#ifndef REVISIT_TESTS_SERVER_HELD_STORAGE_H_
#define REVISIT_TESTS_SERVER_HELD_STORAGE_H_

#include <atomic>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <functional>
#include <mutex>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "server/storage/storage.h"

namespace revisit::server {

// Passes everything on to another storage, which must outlive it. Thread-safe.
class HeldStorage : public Storage {
 public:
  explicit HeldStorage(Storage* storage) : storage_(storage) {}

  // From now on writes wait.
  void Hold() {
    const std::lock_guard<std::mutex> guard(mutex_);
    hold_ = true;
  }

  // Waits until this many writes wait.
  void Await(std::size_t count) {
    std::unique_lock<std::mutex> lock(mutex_);
    changed_.wait(lock, [&] { return held_.size() >= count; });
  }

  std::size_t held() {
    const std::lock_guard<std::mutex> guard(mutex_);
    return held_.size();
  }

  // Counts the calls of PutChecks().
  std::size_t check_writes() const { return check_writes_; }

  // Passes on the one that waits longest.
  void ReleaseOne() { TakeOne().pass_on(); }

  // Passes on all, and from now on every write at once: not before those that
  // waited are through, since the storage takes them in the order they come.
  void ReleaseAll() {
    std::unique_lock<std::mutex> lock(mutex_);
    while (!held_.empty()) {
      const Write write = std::move(held_.front());
      held_.pop_front();
      lock.unlock();
      write.pass_on();
      lock.lock();
    }
    hold_ = false;
  }

  // Answers the one that waits longest with this instead.
  void FailOne(const absl::Status& status) { TakeOne().answer(status); }

  // Passes it on and answers with this all the same.
  void PassOnAndFailOne(const absl::Status& status) {
    const Write write = TakeOne();
    write.pass_on_silently();
    write.answer(status);
  }

  // Answers the next write of checks with this, written or not.
  void FailNextChecks(const absl::Status& status, bool is_written) {
    const std::lock_guard<std::mutex> guard(mutex_);
    fate_ = Fate{status, is_written};
  }

  // If not OK, reads answer this.
  void FailReads(const absl::Status& status) {
    const std::lock_guard<std::mutex> guard(mutex_);
    read_status_ = status;
  }

  void CreateVehicle(
      VehicleRecord record,
      std::function<void(absl::StatusOr<VehicleKey>)> done) override {
    Submit({[=] { storage_->CreateVehicle(record, done); },
            [=] {
              storage_->CreateVehicle(record,
                                      [](const absl::StatusOr<VehicleKey>&) {});
            },
            [=](const absl::Status& status) { done(status); }});
  }
  void UpdateVehicle(VehicleKey key, std::string payload,
                     std::uint64_t revision, Done done) override {
    Submit(std::move(done), [=](Done then) {
      storage_->UpdateVehicle(key, payload, revision, std::move(then));
    });
  }
  void DeleteVehicle(VehicleKey key, EventRecord farewell, Done done) override {
    Submit(std::move(done), [=](Done then) {
      storage_->DeleteVehicle(key, farewell, std::move(then));
    });
  }
  void AppendBatches(VehicleKey key, std::vector<BatchRecord> batches,
                     std::optional<std::string> vehicle_payload,
                     Done done) override {
    Submit(std::move(done), [=](Done then) {
      storage_->AppendBatches(key, batches, vehicle_payload, std::move(then));
    });
  }
  std::size_t MostBatchBytes() const override {
    return storage_->MostBatchBytes();
  }
  bool KeepsColumns() const override { return storage_->KeepsColumns(); }
  void ReviseBatches(VehicleKey key, BatchSource batches,
                     std::uint64_t revision, Done done) override {
    Submit(std::move(done), [=](Done then) {
      storage_->ReviseBatches(key, batches, revision, std::move(then));
    });
  }
  void ReplaceBatches(VehicleKey key, std::vector<BatchVersions> batches,
                      std::uint64_t revision, Done done) override {
    Submit(std::move(done), [=](Done then) {
      storage_->ReplaceBatches(key, batches, revision, std::move(then));
    });
  }
  void AddPosePair(VehicleKey key, PairKind kind, PosePairRecord pair,
                   std::optional<ChecksWrite> checks, std::uint64_t revision,
                   Done done) override {
    Submit(std::move(done), [=](Done then) {
      storage_->AddPosePair(key, kind, pair, checks, revision, std::move(then));
    });
  }
  void DeletePosePair(VehicleKey key, DeletedPairRecord deleted,
                      std::optional<ChecksWrite> checks, std::uint64_t revision,
                      Done done) override {
    Submit(std::move(done), [=](Done then) {
      storage_->DeletePosePair(key, deleted, checks, revision, std::move(then));
    });
  }
  void PutChecks(VehicleKey key, ChecksWrite checks, Done done) override {
    ++check_writes_;
    if (const auto fate = TakeFate()) {
      if (fate->is_written) {
        storage_->PutChecks(key, checks, [](const absl::Status&) {});
      }
      done(fate->answer);
      return;
    }
    Submit(std::move(done), [=](Done then) {
      storage_->PutChecks(key, checks, std::move(then));
    });
  }
  void DropEvents(std::int64_t before_ns, int most, Done done) override {
    storage_->DropEvents(before_ns, most, std::move(done));
  }

  void DropDamaged(VehicleKey key, std::uint64_t last_sequence,
                   std::string payload, std::uint64_t revision,
                   Done done) override {
    Submit(std::move(done), [=](Done then) {
      storage_->DropDamaged(key, last_sequence, payload, revision,
                            std::move(then));
    });
  }

  bool KeepsSnapshots() const override { return storage_->KeepsSnapshots(); }
  void PutSnapshotPart(VehicleKey key, std::uint32_t number, std::string part,
                       Done done) override {
    Submit(std::move(done), [=](Done then) {
      storage_->PutSnapshotPart(key, number, part, std::move(then));
    });
  }
  void PutSnapshot(VehicleKey key, SnapshotRecord snapshot,
                   Done done) override {
    Submit(std::move(done), [=](Done then) {
      storage_->PutSnapshot(key, snapshot, std::move(then));
    });
  }
  void DropSnapshot(VehicleKey key, Done done) override {
    Submit(std::move(done),
           [=](Done then) { storage_->DropSnapshot(key, std::move(then)); });
  }
  void PutMarks(VehicleKey key, std::string marks, Done done) override {
    Submit(std::move(done),
           [=](Done then) { storage_->PutMarks(key, marks, std::move(then)); });
  }
  absl::StatusOr<std::optional<std::string>> GetMarks(VehicleKey key) override {
    return storage_->GetMarks(key);
  }
  absl::StatusOr<std::optional<SnapshotRecord>> GetSnapshot(
      VehicleKey key) override {
    return storage_->GetSnapshot(key);
  }
  absl::Status ReadSnapshotParts(
      VehicleKey key, std::uint32_t first, std::uint32_t end,
      const std::function<bool(absl::string_view)>& visit) override {
    return storage_->ReadSnapshotParts(key, first, end, visit);
  }

  absl::StatusOr<VehicleRecord> TakeVehicle(const std::string& id) override {
    const absl::Status status = ReadStatus();
    if (!status.ok()) return status;
    return storage_->TakeVehicle(id);
  }
  void ReleaseVehicle(VehicleKey key) override {
    storage_->ReleaseVehicle(key);
  }
  absl::Status CheckOwned(VehicleKey key) const override {
    return storage_->CheckOwned(key);
  }
  void ConfirmOwned(VehicleKey key, Done done) override {
    Submit(std::move(done),
           [=](Done then) { storage_->ConfirmOwned(key, std::move(then)); });
  }
  void OnWanted(const HandOver& hand_over) override {
    storage_->OnWanted(hand_over);
  }
  absl::StatusOr<VehicleRecord> GetVehicle(const std::string& id) override {
    const absl::Status status = ReadStatus();
    if (!status.ok()) return status;
    return storage_->GetVehicle(id);
  }
  absl::StatusOr<std::vector<VehicleRecord>> GetVehicles(
      const std::set<std::string>& ids) override {
    const absl::Status status = ReadStatus();
    if (!status.ok()) return status;
    return storage_->GetVehicles(ids);
  }
  absl::StatusOr<std::vector<VehicleRecord>> ListVehicles(
      const std::string& after_id, const std::string& prefix,
      int limit) override {
    const absl::Status status = ReadStatus();
    if (!status.ok()) return status;
    return storage_->ListVehicles(after_id, prefix, limit);
  }
  absl::StatusOr<std::vector<VehicleRecord>> ListVehicleRows(
      VehicleKey after_key, int limit) override {
    const absl::Status status = ReadStatus();
    if (!status.ok()) return status;
    return storage_->ListVehicleRows(after_key, limit);
  }
  absl::Status ReadBatches(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      BatchVersion version,
      const std::function<bool(BatchRecord)>& visit) override {
    const absl::Status status = ReadStatus();
    if (!status.ok()) return status;
    return storage_->ReadBatches(key, first_sequence, last_sequence, version,
                                 visit);
  }
  absl::StatusOr<std::vector<PosePairRecord>> ListPosePairs(
      VehicleKey key, PairKind kind, const std::string& after_id,
      int limit) override {
    const absl::Status status = ReadStatus();
    if (!status.ok()) return status;
    return storage_->ListPosePairs(key, kind, after_id, limit);
  }
  absl::StatusOr<std::vector<DeletedPairRecord>> ListDeletedPairs(
      VehicleKey key) override {
    const absl::Status status = ReadStatus();
    if (!status.ok()) return status;
    return storage_->ListDeletedPairs(key);
  }
  absl::StatusOr<std::vector<CheckRecord>> ListChecks(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      bool open_only, int limit) override {
    const absl::Status status = ReadStatus();
    if (!status.ok()) return status;
    return storage_->ListChecks(key, first_sequence, last_sequence, open_only,
                                limit);
  }
  absl::StatusOr<std::vector<VehicleRecord>> ListUnchecked(VehicleKey after_key,
                                                           int limit) override {
    const absl::Status status = ReadStatus();
    if (!status.ok()) return status;
    return storage_->ListUnchecked(after_key, limit);
  }
  absl::StatusOr<std::vector<EventRecord>> ReadEvents(
      const EventPosition& after, int limit) override {
    const absl::Status status = ReadStatus();
    if (!status.ok()) return status;
    return storage_->ReadEvents(after, limit);
  }
  absl::StatusOr<EventPosition> LastEvent() override {
    const absl::Status status = ReadStatus();
    if (!status.ok()) return status;
    return storage_->LastEvent();
  }
  GroupStorage& Groups() override { return storage_->Groups(); }

 private:
  struct Fate {
    absl::Status answer;
    bool is_written = false;
  };

  std::optional<Fate> TakeFate() {
    const std::lock_guard<std::mutex> guard(mutex_);
    return std::exchange(fate_, std::nullopt);
  }

  struct Write {
    std::function<void()> pass_on;
    std::function<void()> pass_on_silently;
    Done answer;
  };

  void Submit(Done done, const std::function<void(Done)>& write) {
    Submit({[=] { write(done); }, [=] { write([](const absl::Status&) {}); },
            done});
  }

  void Submit(Write write) {
    {
      const std::lock_guard<std::mutex> guard(mutex_);
      if (hold_) {
        held_.push_back(std::move(write));
        changed_.notify_all();
        return;
      }
    }
    write.pass_on();
  }

  Write TakeOne() {
    std::unique_lock<std::mutex> lock(mutex_);
    changed_.wait(lock, [&] { return !held_.empty(); });
    Write write = std::move(held_.front());
    held_.pop_front();
    return write;
  }

  absl::Status ReadStatus() {
    const std::lock_guard<std::mutex> guard(mutex_);
    return read_status_;
  }

  Storage* const storage_;
  std::atomic<std::size_t> check_writes_{0};
  std::mutex mutex_;
  std::condition_variable changed_;
  bool hold_ = false;
  std::deque<Write> held_;
  absl::Status read_status_;
  std::optional<Fate> fate_;
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_HELD_STORAGE_H_
