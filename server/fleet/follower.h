// The drive of a vehicle as it is stored, read without owning the vehicle, and
// brought up to date whenever that is asked for.
#ifndef REVISIT_SERVER_FLEET_FOLLOWER_H_
#define REVISIT_SERVER_FLEET_FOLLOWER_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/fleet/known_history.h"
#include "server/sessions/drive_replay.h"
#include "server/sessions/vehicle_reader.h"
#include "server/storage/records.h"

namespace revisit::server {

// Each change of a vehicle raises its revision by one, and so does each row of
// batches. So a revision that has grown by the rows that came, and by no more,
// says that poses were only added. Otherwise the drive is made anew.
//
// Thread-compatible.
class Follower {
 public:
  // The vehicle must outlive this.
  explicit Follower(const VehicleReader* vehicle) : vehicle_(vehicle) {}

  // Goes on, until `go_on` says false, to the state of a row that was just
  // read. Returns whether that is reached; otherwise read the row again and
  // call again. Errors: DATA_LOSS if the vehicle is damaged; those of reads.
  absl::StatusOr<bool> Continue(const VehicleRecord& record,
                                const DriveReplay::GoOn& go_on);

  // The history as of the row that was reached. Null before the first.
  const std::shared_ptr<const KnownHistory>& history() const {
    return history_;
  }
  // Whether a drive that takes the place of the one before is in the making.
  bool is_making() const { return making_.has_value(); }
  // Of the drives: of the one that is followed and of the one in the making.
  std::int64_t bytes() const;
  // How often a drive was begun.
  std::uint64_t made() const { return made_; }

 private:
  struct Made {
    // The row with which the drive was begun.
    VehicleKey key = 0;
    std::string payload;
    std::uint64_t begun_at = 0;
    JudgedPairs pairs;
    std::unique_ptr<DriveReplay> replay;
    // Whether the drive has all that there was then.
    bool has_begun = false;
    // The revision of the row up to which it was read, and the rows of batches
    // until then.
    std::uint64_t revision = 0;
    std::uint64_t rows = 0;
  };
  // kAgain: with the row as it is by then.
  enum class Reached { kRow, kAgain, kNeverWill };

  absl::Status Begin(const VehicleRecord& record);
  // Brings a drive to the row; kNeverWill where it was made of what is not
  // stored any more.
  absl::StatusOr<Reached> Advance(const VehicleRecord& record,
                                  const DriveReplay::GoOn& go_on,
                                  Made* made) const;
  absl::StatusOr<Reached> FinishBegun(const VehicleRecord& record,
                                      Made* made) const;
  void Publish();

  const VehicleReader* const vehicle_;
  std::optional<Made> followed_;
  std::optional<Made> making_;
  std::shared_ptr<const KnownHistory> history_;
  std::uint64_t made_ = 0;
  std::string series_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FLEET_FOLLOWER_H_
