#include "server/sessions/check_basis.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>

#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "server/groups/link_kind.h"
#include "xxhash.h"

namespace revisit::server {
namespace {

// Joins a value to a hash.
std::uint64_t Joined(std::uint64_t hash, const void* bytes, std::size_t size) {
  return XXH3_64bits_withSeed(bytes, size, hash);
}

std::uint64_t Joined(std::uint64_t hash, std::uint64_t value) {
  return Joined(hash, &value, sizeof(value));
}

std::uint64_t Joined(std::uint64_t hash, double value) {
  return Joined(hash, &value, sizeof(value));
}

std::uint64_t Joined(std::uint64_t hash, const std::string& text) {
  return Joined(Joined(hash, std::uint64_t{text.size()}), text.data(),
                text.size());
}

std::uint64_t HashOf(PairKind kind, const PosePairRecord& pair) {
  std::uint64_t hash =
      Joined(static_cast<std::uint64_t>(NumberOf(kind)), pair.id);
  hash = Joined(hash, pair.query_sequence);
  hash = Joined(hash, pair.matched_sequence);
  hash = Joined(hash, static_cast<std::uint64_t>(pair.create_time_ns));
  return Joined(hash, pair.payload);
}

std::uint64_t Joined(std::uint64_t hash, const VehiclePose& pose) {
  return Joined(Joined(hash, static_cast<std::uint64_t>(pose.vehicle)),
                pose.sequence);
}

std::uint64_t HashOf(const GroupLinkRecord& link) {
  std::uint64_t hash = Joined(static_cast<std::uint64_t>(link.state), link.id);
  hash = Joined(Joined(hash, link.query), link.matched);
  return Joined(hash, link.payload);
}

// 0 where nothing ties the vehicle.
std::uint64_t HashOf(const CheckTies& ties) {
  std::uint64_t hash = 0;
  if (!ties.member.empty()) hash = Joined(hash, ties.member);
  for (const CheckTies::Tie& tie : ties.ties) {
    hash = Joined(hash, HashOf(tie.link));
  }
  return hash;
}

std::uint64_t JoinedPose(std::uint64_t hash, const core::PoseGraph& graph,
                         std::uint64_t sequence) {
  const auto index = graph.NodeAtOrBefore(sequence);
  if (!index) return Joined(hash, std::uint64_t{0});
  const core::Node node = graph.node(*index);
  for (const double value :
       {node.pose.x, node.pose.y, node.pose.z, node.pose.heading,
        node.covariance(0, 0), node.covariance(1, 1), node.covariance(3, 3)}) {
    hash = Joined(hash, value);
  }
  return hash;
}

}  // namespace

void CheckBasis::SumsByPlace::Finish() {
  std::sort(sums_.begin(), sums_.end());
  std::uint64_t sum = 0;
  for (auto& [place, hash] : sums_) hash = sum += hash;
}

std::uint64_t CheckBasis::SumsByPlace::UpTo(double place) const {
  const auto behind = std::upper_bound(
      sums_.begin(), sums_.end(),
      std::make_pair(place, std::numeric_limits<std::uint64_t>::max()));
  return behind == sums_.begin() ? 0 : std::prev(behind)->second;
}

std::uint64_t CheckBasis::SumsByPlace::Below(double place) const {
  const auto first = std::lower_bound(sums_.begin(), sums_.end(),
                                      std::make_pair(place, std::uint64_t{0}));
  return first == sums_.begin() ? 0 : std::prev(first)->second;
}

const std::string& CheckBasis::Group() const {
  static const std::string* const kNone = new std::string();
  return searches_groups_ ? vehicle_->head.config().check_group : *kNone;
}

void CheckBasis::Learn(const std::string& group_id, CheckTiesPtr ties) {
  const bool is_older = ties_ != nullptr && ties_of_ == group_id &&
                        ties_->version && ties->version &&
                        ties->version->uid == ties_->version->uid &&
                        ties->version->revision < ties_->version->revision;
  if (is_older) return;
  const std::uint64_t hash = HashOf(*ties);
  if (hash != ties_hash_) ++ties_version_;
  ties_ = std::move(ties);
  ties_hash_ = hash;
  ties_of_ = group_id;
}

bool CheckBasis::IsTiedBy(const CheckTiesPtr& ties) const {
  return (ties == nullptr ? 0 : HashOf(*ties)) ==
         (Group().empty() ? 0 : ties_hash_);
}

CheckBasis::Version CheckBasis::version() const {
  return {vehicle_->loaded.series(), vehicle_->head.config_version(),
          vehicle_->pairs.version(), ties_version_};
}

void CheckBasis::Refresh() {
  const Version now = version();
  if (version_ == now) return;
  if (!version_ || version_->config != now.config) {
    // The part of the config that searches and the choice of candidates depend
    // on.
    VehicleConfig config;
    config.checks = ChecksKept::kStored;
    config.drive = vehicle_->head.config().drive;
    config.keep_probability = vehicle_->head.config().keep_probability;
    settings_ = Joined(0, vehicle_->codec->EncodeVehicle(config));
  }
  version_ = now;
  pairs_.Clear();
  rejected_queries_.Clear();
  rejected_matches_.Clear();
  const core::PoseGraph& graph = vehicle_->loaded->graph();
  for (const PairKind kind : kPairKinds) {
    for (const auto& [id, pair] : vehicle_->pairs.Of(kind)) {
      const auto later = graph.NodeAtOrBefore(pair.query_sequence);
      if (!pair.damage.ok() || !later) continue;
      pairs_.Add(static_cast<double>(*later), HashOf(kind, pair));
    }
  }
  for (const auto& [id, pair] : vehicle_->pairs.rejections()) {
    if (!pair.damage.ok()) continue;
    const std::uint64_t hash = HashOf(PairKind::kRejectedCandidate, pair);
    const auto add = [&](std::uint64_t sequence, SumsByPlace* sums) {
      const auto node = graph.NodeAtOrBefore(sequence);
      if (node) sums->Add(graph.node(*node).travelled_meters, hash);
    };
    add(pair.query_sequence, &rejected_queries_);
    add(pair.matched_sequence, &rejected_matches_);
  }
  pairs_.Finish();
  rejected_queries_.Finish();
  rejected_matches_.Finish();
}

std::uint64_t CheckBasis::JoinedTies(std::uint64_t hash, core::NodeIndex node,
                                     const CheckTiesPtr& ties) const {
  if (ties == nullptr) return hash;
  if (!ties->member.empty()) hash = Joined(hash, ties->member);
  const core::PoseGraph& graph = vehicle_->loaded->graph();
  const double travelled = graph.node(node).travelled_meters;
  for (const CheckTies::Tie& tie : ties->ties) {
    const auto own = graph.NodeAtOrBefore(tie.own_sequence);
    if (!own) continue;
    // A search does not know what was tied behind its node.
    const bool is_meant = KindOf(tie.link) == PairKind::kLoopClosure
                              ? *own <= node
                              : std::abs(graph.node(*own).travelled_meters -
                                         travelled) <= RejectionRadius();
    if (is_meant) hash = Joined(hash, HashOf(tie.link));
  }
  return hash;
}

double CheckBasis::RejectionRadius() const {
  return std::max(
      core::kPlaceRadiusMeters,
      vehicle_->head.config().drive.search.candidate_separation_meters);
}

std::uint64_t CheckBasis::Of(std::uint64_t check_sequence,
                             const std::vector<StoredCandidate>& candidates) {
  return Of(check_sequence, candidates, Group().empty() ? nullptr : ties_);
}

std::uint64_t CheckBasis::Of(std::uint64_t check_sequence,
                             const std::vector<StoredCandidate>& candidates,
                             const CheckTiesPtr& ties) {
  Refresh();
  const core::PoseGraph& graph = vehicle_->loaded->graph();
  std::uint64_t hash = JoinedPose(settings_, graph, check_sequence);
  for (const StoredCandidate& candidate : candidates) {
    if (candidate.is_own()) {
      hash = JoinedPose(hash, graph, candidate.matched_sequence);
    } else {
      hash = Joined(Joined(hash, candidate.matched_uid),
                    candidate.matched_sequence);
    }
  }
  const auto node = graph.NodeAtOrBefore(check_sequence);
  if (!node) return hash;
  hash = Joined(hash, pairs_.UpTo(static_cast<double>(*node)));
  const double travelled = graph.node(*node).travelled_meters;
  const double radius = RejectionRadius();
  for (const SumsByPlace* sums : {&rejected_queries_, &rejected_matches_}) {
    hash = Joined(
        hash, sums->UpTo(travelled + radius) - sums->Below(travelled - radius));
  }
  hash = JoinedTies(hash, *node, ties);
  // 0 stands for a check that has none yet.
  return hash == 0 ? 1 : hash;
}

}  // namespace revisit::server
