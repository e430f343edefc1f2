#include "server/sessions/vehicle_census.h"

#include <algorithm>
#include <utility>

#include "server/base/metrics.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

constexpr int kRowsPerRead = 1000;
// Others of the machine wait for no longer.
constexpr std::chrono::milliseconds kSlice{50};

}  // namespace

VehicleCensus::VehicleCensus(
    Storage* storage, const RecordCodec* codec,
    std::optional<std::chrono::milliseconds> again_after)
    : storage_(storage), codec_(codec), again_after_(again_after) {}

void VehicleCensus::Continue() {
  const auto now = Clock::now();
  if (!is_reading_) {
    const bool is_due =
        !finished_ || (again_after_ && now >= *finished_ + *again_after_);
    if (!is_due) return;
    Begin();
  }
  do {
    const auto rows = storage_->ListVehicleRows(
        keys_.empty() ? 0 : keys_.back(), kRowsPerRead);
    if (!rows.ok()) return;
    Take(*rows);
    if (rows->size() < kRowsPerRead) {
      Finish();
      return;
    }
  } while (Clock::now() < now + kSlice);
}

void VehicleCensus::Begin() {
  is_reading_ = true;
  keys_.clear();
  states_read_.clear();
  const MutexLock lock(&mutex_);
  keeps_news_ = true;
  news_.clear();
}

void VehicleCensus::Take(const std::vector<VehicleRecord>& rows) {
  for (const VehicleRecord& row : rows) {
    keys_.push_back(row.key);
    const State state = StateOf(row);
    if (state != State::kActive) states_read_.emplace(row.key, state);
  }
}

void VehicleCensus::Finish() {
  is_reading_ = false;
  finished_ = Clock::now();
  const std::vector<VehicleKey> keys = std::move(keys_);
  keys_ = {};
  const MutexLock lock(&mutex_);
  states_ = std::exchange(states_read_, {});
  count_ = static_cast<std::int64_t>(keys.size());
  counted_to_ = keys.empty() ? 0 : keys.back();
  for (const auto& [key, state] : news_) {
    const bool is_counted = std::binary_search(keys.begin(), keys.end(), key);
    if (state) {
      if (!is_counted) ++count_;
      SetState(key, *state);
    } else {
      if (is_counted) --count_;
      states_.erase(key);
    }
    counted_to_ = std::max(*counted_to_, key);
  }
  keeps_news_ = false;
  news_.clear();
}

VehicleCensus::State VehicleCensus::StateOf(const VehicleRecord& row) const {
  if (!row.damage.ok()) return State::kDamaged;
  const absl::StatusOr<VehicleConfig> config = codec_->DecodeVehicle(row);
  if (!config.ok() || config->damaged) return State::kDamaged;
  return config->data_loss ? State::kDataLoss : State::kActive;
}

std::optional<VehicleCensus::Counts> VehicleCensus::Read() const {
  const MutexLock lock(&mutex_);
  if (!counted_to_) return std::nullopt;
  Counts counts;
  for (const auto& [key, state] : states_) {
    ++(state == State::kDamaged ? counts.damaged : counts.data_loss);
  }
  counts.active = count_ - counts.damaged - counts.data_loss;
  return counts;
}

void VehicleCensus::CollectMetrics(Metrics* metrics) const {
  const std::optional<Counts> counts = Read();
  if (!counts) return;
  MetricFamily& vehicles =
      metrics->Gauge("revisit_vehicles", "Vehicles of the store, by state.");
  vehicles.Add(counts->active, {{"state", "active"}});
  vehicles.Add(counts->data_loss, {{"state", "data_loss"}});
  vehicles.Add(counts->damaged, {{"state", "damaged"}});
}

void VehicleCensus::Created(VehicleKey key) {
  const MutexLock lock(&mutex_);
  if (keeps_news_) news_.emplace(key, State::kActive);
  // The rows may have been read since it was created: keys only grow.
  if (!counted_to_ || key <= *counted_to_) return;
  ++count_;
  counted_to_ = key;
}

void VehicleCensus::Found(VehicleKey key, State state) {
  const MutexLock lock(&mutex_);
  if (keeps_news_) news_[key] = state;
  SetState(key, state);
}

void VehicleCensus::Deleted(VehicleKey key) {
  const MutexLock lock(&mutex_);
  if (keeps_news_) news_[key] = std::nullopt;
  states_.erase(key);
  if (counted_to_) --count_;
}

void VehicleCensus::SetState(VehicleKey key, State state) {
  if (state == State::kActive) {
    states_.erase(key);
  } else {
    states_[key] = state;
  }
}

}  // namespace revisit::server
