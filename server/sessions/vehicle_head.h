// A vehicle apart from its drive: which one it is, its settings, how far what
// is stored goes, and what appends in flight will make of that.
#ifndef REVISIT_SERVER_SESSIONS_VEHICLE_HEAD_H_
#define REVISIT_SERVER_SESSIONS_VEHICLE_HEAD_H_

#include <cstdint>
#include <optional>

#include "absl/status/status.h"
#include "server/sessions/vehicle_config.h"
#include "server/storage/storage.h"

namespace revisit::server {

// Belongs to the session's strand.
class VehicleHead {
 public:
  // The vehicle as it will be once all appends in flight are durable and
  // applied.
  struct Staged {
    VehicleConfig config;
    std::uint64_t sequence = 0;
    std::uint64_t revision = 0;
  };

  VehicleKey key() const { return key_; }
  // See VehicleRecord.
  std::int64_t epoch() const { return epoch_; }
  const VehicleConfig& config() const { return config_; }
  // Counts the configs that were taken on.
  std::uint64_t config_version() const { return config_version_; }
  std::uint64_t durable_sequence() const { return durable_sequence_; }
  std::uint64_t revision() const { return revision_; }
  const Staged& staged() const { return staged_; }
  // As the store has it.
  const ChecksHead& checks() const { return checks_; }
  void set_checks(const ChecksHead& checks) { checks_ = checks; }
  // See VehicleView. While the vehicle is loaded, the first cause.
  const absl::Status& damage() const { return damage_; }
  bool config_is_known() const { return config_is_known_; }

  // ---- While the vehicle is loaded

  void Found(VehicleKey key, std::int64_t epoch) {
    key_ = key;
    epoch_ = epoch;
  }
  // The settings cannot be read: the config stays a default one.
  void LoseConfig() { config_is_known_ = false; }
  // The poses up to this one are sound.
  void set_durable_sequence(std::uint64_t sequence) {
    durable_sequence_ = sequence;
  }
  void NoteDamage(const absl::Status& cause) {
    if (damage_.ok()) damage_ = cause;
  }
  // Replaces the cause by what callers are told of it.
  void set_damage(const absl::Status& damage) { damage_ = damage; }

  // ---- Later

  // The store has given the vehicle to this server once more.
  void set_epoch(std::int64_t epoch) { epoch_ = epoch; }
  // An operator has given up what was damaged.
  void AcceptDamage() { damage_ = absl::OkStatus(); }

  // Takes on a config and a revision that are durable. REQUIRES: no append is
  // in flight.
  void Adopt(const VehicleConfig& config, std::uint64_t revision) {
    // The argument may be the config itself.
    if (&config != &config_) {
      config_ = config;
      ++config_version_;
    }
    revision_ = revision;
    staged_ = {config_, durable_sequence_, revision_};
  }
  // Takes on a durable revision that changed neither config nor poses.
  void Adopt(std::uint64_t revision) { Adopt(config_, revision); }
  // A client knows of poses that are not stored. Appends in flight go on.
  void LoseData() { config_.data_loss = true; }

  // ---- Appends: staged one behind the other, then durable in this order

  void StageOrigin(const GeodeticOrigin& origin) {
    staged_.config.origin = origin;
  }
  // The revision of one more row.
  std::uint64_t StageRow() { return ++staged_.revision; }
  // The rows staged last reach this sequence.
  void StageUpTo(std::uint64_t sequence) { staged_.sequence = sequence; }
  // The append that was staged first is durable and applied.
  void Advance(std::uint64_t sequence, std::uint64_t revision,
               const std::optional<GeodeticOrigin>& origin) {
    durable_sequence_ = sequence;
    revision_ = revision;
    if (!config_.origin) config_.origin = origin;
  }

 private:
  VehicleKey key_ = 0;
  std::int64_t epoch_ = 0;
  VehicleConfig config_;
  std::uint64_t config_version_ = 0;
  std::uint64_t durable_sequence_ = 0;
  std::uint64_t revision_ = 0;
  ChecksHead checks_;
  Staged staged_;
  absl::Status damage_;
  bool config_is_known_ = true;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_VEHICLE_HEAD_H_
