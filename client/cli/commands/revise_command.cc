#include "client/cli/commands/revise_command.h"

#include <algorithm>
#include <memory>
#include <unordered_map>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/answers/exact_text.h"
#include "client/answers/names.h"
#include "client/revisit/printable_text.h"
#include "client/trajectory/drive_poses.h"
#include "client/trajectory/joined_covariances.h"
#include "client/trajectory/local_pose.h"
#include "client/trajectory/stored_poses.h"

namespace revisit::client {
namespace {

// Stamps that came through a double are the same within this.
constexpr std::int64_t kStampNanoseconds = 1000;

std::int64_t Nanoseconds(const google::protobuf::Timestamp& stamp) {
  return stamp.seconds() * 1'000'000'000 + stamp.nanos();
}

// The poses of a file, each to be found by one stored pose.
class OptimisedPoses {
 public:
  // `poses` must outlive this. An error names two lines about the same pose.
  static absl::StatusOr<OptimisedPoses> Make(
      const std::string& path, const std::vector<OptimisedPose>& poses) {
    OptimisedPoses made(path, poses);
    for (std::size_t i = 0; i < poses.size(); ++i) {
      if (poses[i].stamp_nanoseconds) {
        made.by_stamp_.emplace_back(*poses[i].stamp_nanoseconds, i);
      } else if (const auto [other, added] =
                     made.by_sequence_.emplace(*poses[i].sequence, i);
                 !added) {
        return made.Error(
            poses[i],
            absl::StrCat("line ", poses[other->second].line,
                         " is about sequence ", *poses[i].sequence, " too"));
      }
    }
    auto& stamps = made.by_stamp_;
    std::sort(stamps.begin(), stamps.end());
    for (std::size_t i = 1; i < stamps.size(); ++i) {
      if (stamps[i].first - stamps[i - 1].first <= 2 * kStampNanoseconds) {
        return made.Error(
            poses[stamps[i].second],
            absl::StrCat("line ", poses[stamps[i - 1].second].line,
                         " has this stamp too"));
      }
    }
    return made;
  }

  // The pose of the file that is about a stored one; null if none is. An error
  // if it was about an earlier one as well.
  absl::StatusOr<const OptimisedPose*> Find(const v1::Pose& stored) {
    const OptimisedPose* found = nullptr;
    const auto by_sequence = by_sequence_.find(stored.sequence());
    if (by_sequence != by_sequence_.end()) {
      found = &poses_[by_sequence->second];
    } else if (stored.has_stamp()) {
      const std::int64_t stamp = Nanoseconds(stored.stamp());
      const auto near = std::lower_bound(
          by_stamp_.begin(), by_stamp_.end(),
          std::make_pair(stamp - kStampNanoseconds, std::size_t{0}));
      if (near != by_stamp_.end() && near->first <= stamp + kStampNanoseconds) {
        found = &poses_[near->second];
      }
    }
    if (found == nullptr) return found;
    std::uint64_t& taken = taken_[found->line];
    if (taken != 0) {
      return Error(*found,
                   absl::StrCat("this stamp is that of sequences ", taken,
                                " and ", stored.sequence(),
                                "; --format g2o and csv name sequences"));
    }
    taken = stored.sequence();
    return found;
  }

  // How many were never found, because the vehicle has dropped them; an error
  // if that cannot be the reason.
  absl::StatusOr<std::int64_t> CountDropped(const v1::Vehicle& vehicle) const {
    const std::string& name = vehicle.name();
    std::int64_t dropped = 0;
    for (const OptimisedPose& pose : poses_) {
      if (taken_.count(pose.line) > 0) continue;
      if (vehicle.dropped_pose_count() > 0 &&
          pose.sequence.value_or(1) <= vehicle.durable_sequence()) {
        ++dropped;
        continue;
      }
      if (pose.sequence) {
        return Error(pose, absl::StrCat(name, " has no pose of sequence ",
                                        *pose.sequence));
      }
      google::protobuf::Timestamp stamp;
      stamp.set_seconds(*pose.stamp_nanoseconds / 1'000'000'000);
      stamp.set_nanos(
          static_cast<int>(*pose.stamp_nanoseconds % 1'000'000'000));
      return Error(pose,
                   absl::StrCat(name, " has no pose of the stamp ",
                                StampSeconds(stamp), " s, to a microsecond"));
    }
    return dropped;
  }

 private:
  OptimisedPoses(const std::string& path,
                 const std::vector<OptimisedPose>& poses)
      : path_(path), poses_(poses) {}

  absl::Status Error(const OptimisedPose& pose,
                     const std::string& message) const {
    return LocalError(absl::InvalidArgumentError(
        absl::StrCat(path_, ":", pose.line, ": ", message)));
  }

  const std::string path_;
  const std::vector<OptimisedPose>& poses_;
  std::unordered_map<std::uint64_t, std::size_t> by_sequence_;
  std::vector<std::pair<std::int64_t, std::size_t>> by_stamp_;
  // The stored sequence that a line was found by.
  std::unordered_map<std::int64_t, std::uint64_t> taken_;
};

// A stored pose with its new estimate, in the vehicle's local frame.
v1::Pose Revised(const v1::Pose& stored, const OptimisedPose& optimised,
                 const LocalFrame& frame, bool spatial) {
  const LocalPose local = frame.Localize(stored);
  v1::Pose pose = stored;
  pose.clear_stamp();
  pose.clear_recording_start();
  if (stored.has_geodetic()) {
    *pose.mutable_covariance() = ToCovariance(local.covariance, spatial);
    if (local.error_transition) {
      SetErrorTransition(*local.error_transition, spatial, &pose);
    }
  }
  pose.mutable_local()->set_x_meters(optimised.x);
  pose.mutable_local()->set_y_meters(optimised.y);
  pose.mutable_local()->set_z_meters(optimised.z.value_or(local.position[2]));
  if (optimised.quaternion || stored.has_quaternion()) {
    SetQuaternion(
        optimised.quaternion
            ? *optimised.quaternion
            : Turned(local.orientation, optimised.heading - local.heading),
        &pose);
  } else {
    pose.set_heading_radians(optimised.heading);
  }
  if (optimised.covariance) *pose.mutable_covariance() = *optimised.covariance;
  return pose;
}

// Gives a pose that is brought into a common frame its covariance there, unless
// the file states one. `after` is the pose as revised.
void Join(const LocalPose& before, const LocalPose& after, bool is_stated,
          bool spatial, JoinedCovariances* joined, v1::Pose* revised) {
  const StateMatrix covariance =
      joined->Next(before, after.position, after.heading);
  if (is_stated) return;
  *revised->mutable_covariance() = ToCovariance(covariance, spatial);
}

// Messages of a revision, as large as is good for streams.
class Messages {
 public:
  Messages(const std::string& vehicle, std::uint64_t expected_revision,
           bool common_frame) {
    messages_.emplace_back();
    messages_.back().set_vehicle(vehicle);
    messages_.back().set_expected_revision(expected_revision);
    messages_.back().set_common_frame(common_frame);
  }

  void Add(v1::Pose pose) {
    constexpr int kPoses = 1000;
    if (messages_.back().poses_size() == kPoses) messages_.emplace_back();
    *messages_.back().add_poses() = std::move(pose);
    ++count_;
  }

  std::uint64_t count() const { return count_; }

  absl::StatusOr<v1::RevisePosesResponse> Send(const Client& client) {
    std::size_t next = 0;
    return client.RevisePoses([&](v1::RevisePosesRequest* request) {
      if (next == messages_.size()) return false;
      request->Swap(&messages_[next++]);
      return true;
    });
  }

 private:
  std::vector<v1::RevisePosesRequest> messages_;
  std::uint64_t count_ = 0;
};

// `missing` poses of the file are not among those that are kept.
void Report(const v1::RevisePosesResponse& revised, const std::string& vehicle,
            std::int64_t missing, const Terminal& terminal) {
  for (const v1::Warning& warning : revised.warnings()) {
    terminal.progress << WarningText(warning) << '\n';
  }
  if (terminal.json()) {
    terminal.out << ToJson(revised, true) << '\n';
    return;
  }
  terminal.out << "revised " << revised.revised_count() << " poses of "
               << Printable(vehicle) << ", revision " << revised.revision()
               << '\n';
  if (const std::int64_t dropped = missing + revised.dropped_count();
      dropped > 0) {
    terminal.out << dropped << " of the file are kept no longer\n";
  }
}

}  // namespace

void AddReviseCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"revise", "Brings optimised poses back into a vehicle.",
       "Formats of FILE:\n"
       "  tum  t x y z qx qy qz qw; poses are found by their stamps, to a "
       "microsecond\n"
       "  g2o  VERTEX_SE2 and VERTEX_SE3:QUAT, whose ids are sequences; edges "
       "are passed over\n"
       "  csv  as revisit export writes it: sequence, est_x, est_y, est_yaw, "
       "and, if they are\n"
       "       there, est_z, the quaternion and the covariance\n"
       "Positions are in the local frame, as revisit export writes them. "
       "Covariances that are\n"
       "not in the file stay as they are stored or, with --common-frame under "
       "dead reckoning,\n"
       "go on over the recordings. All poses change under one "
       "revision, or none:\n"
       "a line that belongs to no stored pose is refused, and so is a stored "
       "pose without a line.",
       "  revisit export shuttle-7 --format g2o --output shuttle-7.g2o\n"
       "  revisit revise shuttle-7 optimised.g2o --format g2o "
       "--expected-revision 4242"});
  const Words formats = {{"tum", static_cast<int>(OptimisedFormat::kTum)},
                         {"g2o", static_cast<int>(OptimisedFormat::kG2o)},
                         {"csv", static_cast<int>(OptimisedFormat::kCsv)}};
  const auto options = std::make_shared<ReviseOptions>();
  command.AddText("VEHICLE", "TEXT", &options->vehicle, "Id, or name")
      .Required();
  command.AddText("FILE", "TEXT", &options->file, "New estimates").Required();
  command.AddChoice("--format", formats, &options->format,
                    "What the file holds (tum)");
  command.AddWholeNumber(
      "--expected-revision", WholeRange(), &options->expected_revision,
      "Revision that the optimiser started from; if the vehicle has another "
      "one, nothing changes (the present one)");
  command.AddSwitch("--partial", &options->partial,
                    "Let stored poses be missing from the file; they stay as "
                    "they are");
  command.AddSwitch("--common-frame", &options->common_frame,
                    "The poses of all recordings are in one frame, as an "
                    "optimiser leaves them: the vehicle has one recording from "
                    "then on. Without it, each pose is in the frame of its own "
                    "recording");
  const Run run = [options](const Connection& server,
                            const Terminal& terminal) {
    return RunRevise(server.client, *options, terminal);
  };
  command.Runs(run, [options]() -> std::string {
    return options->common_frame && options->partial
               ? "--common-frame: does not go with --partial, since poses that "
                 "stay as they are stay in the frames of their recordings"
               : "";
  });
}

absl::Status RunRevise(const Client& client, const ReviseOptions& options,
                       const Terminal& terminal) {
  const auto read = ReadOptimisedFile(options.file, options.format);
  if (!read.ok()) return LocalError(read.status());
  auto optimised = OptimisedPoses::Make(options.file, *read);
  if (!optimised.ok()) return optimised.status();
  const auto vehicle = ReadVehicle(client, VehicleName(options.vehicle));
  if (!vehicle.ok()) return vehicle.status();
  const LocalFrame frame(vehicle->settings());
  const bool spatial =
      vehicle->settings().state_space() == v1::STATE_SPACE_SPATIAL;
  Messages messages(vehicle->name(),
                    options.expected_revision != 0 ? options.expected_revision
                                                   : vehicle->revision(),
                    options.common_frame);
  // Where errors are carried on along the drive, over recordings too.
  const bool is_joined =
      options.common_frame && vehicle->settings().correlation_model() ==
                                  v1::CORRELATION_MODEL_DEAD_RECKONING;
  JoinedCovariances joined;
  std::uint64_t stored = 0;
  const absl::Status matched = VisitPoses(
      client, vehicle->name(), v1::POSE_VIEW_CURRENT,
      [&](const v1::Pose& pose) {
        ++stored;
        const auto found = optimised->Find(pose);
        if (!found.ok()) return found.status();
        if (*found == nullptr) return absl::OkStatus();
        v1::Pose revised = Revised(pose, **found, frame, spatial);
        if (is_joined) {
          Join(frame.Localize(pose), frame.Localize(revised),
               (*found)->covariance.has_value(), spatial, &joined, &revised);
        }
        messages.Add(std::move(revised));
        return absl::OkStatus();
      });
  if (!matched.ok()) return matched;
  const auto missing = optimised->CountDropped(*vehicle);
  if (!missing.ok()) return missing.status();
  if (messages.count() < stored && !options.partial) {
    return LocalError(absl::FailedPreconditionError(absl::StrCat(
        options.file, " has ", messages.count(), " of the ", stored,
        " poses of ", vehicle->name(),
        "; --partial revises these and leaves the others as they are")));
  }
  const auto revised = messages.Send(client);
  if (!revised.ok()) return revised.status();
  Report(*revised, vehicle->name(), *missing, terminal);
  return absl::OkStatus();
}

}  // namespace revisit::client
