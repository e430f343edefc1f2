// A storage that was opened for reading.
#ifndef REVISIT_SERVER_STORAGE_READ_ONLY_STORAGE_H_
#define REVISIT_SERVER_STORAGE_READ_ONLY_STORAGE_H_

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/base/status.h"
#include "server/storage/storage.h"

namespace revisit::server {

// FAILED_PRECONDITION: what a write is answered with.
inline absl::Status OpenedForReading() {
  return Error(absl::StatusCode::kFailedPrecondition, "INTERNAL",
               "this store was opened for reading");
}

// `Reader` is a Storage that lacks the writes; here each of them is answered
// with OpenedForReading().
template <typename Reader>
class ReadOnlyStorage final : public Reader {
 public:
  using Done = Storage::Done;

  template <typename... Arguments>
  explicit ReadOnlyStorage(Arguments&&... arguments)
      : Reader(std::forward<Arguments>(arguments)...) {}

  void CreateVehicle(
      VehicleRecord,
      std::function<void(absl::StatusOr<VehicleKey>)> done) override {
    done(OpenedForReading());
  }
  void UpdateVehicle(VehicleKey, std::string, std::uint64_t,
                     Done done) override {
    done(OpenedForReading());
  }
  void DeleteVehicle(VehicleKey, EventRecord, Done done) override {
    done(OpenedForReading());
  }
  void AppendBatches(VehicleKey, std::vector<BatchRecord>,
                     std::optional<std::string>, Done done) override {
    done(OpenedForReading());
  }
  void ReviseBatches(VehicleKey, BatchSource, std::uint64_t,
                     Done done) override {
    done(OpenedForReading());
  }
  void ReplaceBatches(VehicleKey, std::vector<BatchVersions>, std::uint64_t,
                      Done done) override {
    done(OpenedForReading());
  }
  void AddPosePair(VehicleKey, PairKind, PosePairRecord,
                   std::optional<ChecksWrite>, std::uint64_t,
                   Done done) override {
    done(OpenedForReading());
  }
  void DeletePosePair(VehicleKey, DeletedPairRecord, std::optional<ChecksWrite>,
                      std::uint64_t, Done done) override {
    done(OpenedForReading());
  }
  void PutChecks(VehicleKey, ChecksWrite, Done done) override {
    done(OpenedForReading());
  }
  void DropEvents(std::int64_t, int, Done done) override {
    done(OpenedForReading());
  }
  void DropDamaged(VehicleKey, std::uint64_t, std::string, std::uint64_t,
                   Done done) override {
    done(OpenedForReading());
  }
  void PutSnapshotPart(VehicleKey, std::uint32_t, std::string,
                       Done done) override {
    done(OpenedForReading());
  }
  void PutSnapshot(VehicleKey, SnapshotRecord, Done done) override {
    done(OpenedForReading());
  }
  void DropSnapshot(VehicleKey, Done done) override {
    done(OpenedForReading());
  }
  void PutMarks(VehicleKey, std::string, Done done) override {
    done(OpenedForReading());
  }
  absl::Status CheckWritable() override { return OpenedForReading(); }
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_READ_ONLY_STORAGE_H_
