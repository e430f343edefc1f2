#include "client/cli/commands/sample_sender.h"

#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/cli/commands/shared_flags.h"
#include "client/revisit/client.h"
#include "client/revisit/printable_text.h"
#include "client/trajectory/claim_choice.h"
#include "client/trajectory/drive_poses.h"
#include "client/trajectory/local_pose.h"
#include "grpcpp/channel.h"

namespace revisit::client {
namespace {

// Poses that are looked at before the first is sent.
constexpr std::size_t kMostHeld = 4096;
// How long they wait for others: what a program writes into a pipe at once
// comes within this time.
constexpr std::chrono::milliseconds kLongestHeld{300};

std::string FilesText(const StreamOptions& options) {
  return options.files.size() == 1
             ? options.files[0]
             : absl::StrCat("the ", options.files.size(), " files");
}

PoseStreamOptions MakeStreamOptions(const StreamOptions& options,
                                    const v1::Vehicle& vehicle) {
  PoseStreamOptions stream;
  stream.batch_poses = options.batch_poses;
  stream.acked_sequence = options.acked_sequence;
  stream.vehicle_uid = options.vehicle_uid;
  // A sequence that is claimed without a uid may be that of an earlier vehicle
  // of this name: the present one must not answer for it.
  if (options.vehicle_uid.empty() && options.acked_sequence == 0) {
    stream.vehicle_uid = vehicle.uid();
  }
  stream.send_candidates = options.candidates;
  stream.candidate_options = options.candidate_options;
  stream.give_up_after = options.give_up_after;
  return stream;
}

std::string SessionKey(const std::string& session) {
  return absl::StrCat("session.", session);
}

bool IsFilter(const v1::Vehicle& vehicle) {
  return vehicle.settings().correlation_model() == v1::CORRELATION_MODEL_FILTER;
}

}  // namespace

SampleSender::SampleSender(const std::shared_ptr<grpc::Channel>& channel,
                           const StreamOptions& options,
                           const PoseStreamCallbacks& callbacks,
                           const Terminal& terminal, Progress* progress)
    : channel_(channel),
      options_(options),
      callbacks_(callbacks),
      terminal_(terminal),
      progress_(*progress) {}

void SampleSender::BeginFile(const std::string& file) {
  LetGo();
  file_ = file;
  if (claims_.has_value()) claims_->BeginRecording(file);
  if (starts_.has_value()) starts_->BeginFile(file);
}

absl::Status SampleSender::FinishStream() {
  const absl::Status finished = stream_->Finish();
  interrupt_.reset();
  // Nothing is known of a stream that was never opened.
  if (stream_->acked_sequence() == 0) return finished;
  return WithDurable(finished, vehicle_.name(), *stream_, options_.append);
}

absl::Status SampleSender::WithDurableCount(const absl::Status& error) const {
  return LocalError(
      absl::Status(error.code(),
                   absl::StrCat(error.message(), "; ", vehicle_.name(), " has ",
                                stream_->acked_sequence(), " durable poses")));
}

absl::Status SampleSender::FinishAfter(const absl::Status& error) {
  if (!opened_ || stream_ == nullptr || !status_.ok()) return LocalError(error);
  LetGo();
  const absl::Status finished = FinishStream();
  return finished.ok() ? WithDurableCount(error) : finished;
}

absl::Status SampleSender::Take(const Sample& sample) {
  if (!status_.ok()) return status_;
  ++taken_;
  if (opened_) {
    Send(sample);
    return status_;
  }
  if (held_.empty()) held_since_ = std::chrono::steady_clock::now();
  held_.push_back(sample);
  if (held_.size() >= kMostHeld) LetGo();
  return status_;
}

void SampleSender::LetGo() {
  if (!status_.ok()) return;
  if (!opened_) {
    if (held_.empty()) return;
    status_ = Open();
    opened_ = true;
  }
  for (; !held_.empty(); held_.pop_front()) Send(held_.front());
  Flush();
}

std::optional<std::chrono::milliseconds> SampleSender::BeforeWait() {
  if (!opened_) {
    const auto held = std::chrono::steady_clock::now() - held_since_;
    if (held_.empty()) return std::nullopt;
    if (held < kLongestHeld) {
      return std::chrono::ceil<std::chrono::milliseconds>(kLongestHeld - held);
    }
  }
  LetGo();
  return std::nullopt;
}

absl::Status SampleSender::Finish() {
  LetGo();
  if (status_.ok() && !options_.append && already_durable_ > taken_) {
    (void)FinishStream();
    return LocalError(absl::FailedPreconditionError(absl::StrCat(
        vehicle_.name(), " has ", already_durable_,
        " poses already, more than the ", taken_, " of ", FilesText(options_),
        "; --append adds these behind them")));
  }
  if (stream_ == nullptr) return status_;
  const absl::Status finished = FinishStream();
  if (status_.ok() || !finished.ok()) return finished;
  // The stream itself is sound where this machine is at fault.
  return sent_ > 0 ? WithDurableCount(status_) : status_;
}

absl::StatusOr<v1::Vehicle> SampleSender::GetOrCreate(const Sample& first) {
  const Client client(channel_);
  v1::GetVehicleRequest get;
  get.set_name(VehicleName(options_.vehicle));
  const auto found = client.GetVehicle(get);
  if (found.ok()) return found->vehicle();
  if (!absl::IsNotFound(found.status())) return found.status();
  if (!options_.create) {
    return WithHint(found.status(), "--create makes the vehicle");
  }
  v1::CreateVehicleRequest create;
  create.set_vehicle_id(get.name().substr(get.name().find('/') + 1));
  v1::VehicleSettings* settings = create.mutable_vehicle()->mutable_settings();
  *settings = options_.settings;
  if (first.geodetic.has_value()) {
    settings->set_coordinate_frame(v1::COORDINATE_FRAME_GEODETIC);
  }
  const bool fixes =
      options_.uncertainty_given
          ? options_.uncertainty.source == UncertaintyOptions::Source::kFixes
          : first.heading_variance.has_value();
  if (fixes &&
      settings->correlation_model() == v1::CORRELATION_MODEL_UNSPECIFIED) {
    settings->set_correlation_model(v1::CORRELATION_MODEL_INDEPENDENT);
  }
  const auto created = client.CreateVehicle(create);
  if (!created.ok()) return created.status();
  return created->vehicle();
}

absl::Status SampleSender::CheckThatSamplesFit(const Sample& first) const {
  const v1::VehicleSettings& settings = vehicle_.settings();
  const bool geodetic =
      settings.coordinate_frame() == v1::COORDINATE_FRAME_GEODETIC;
  const auto unfit = [&](const std::string& why) {
    return LocalError(
        absl::FailedPreconditionError(absl::StrCat(vehicle_.name(), " ", why)));
  };
  if (geodetic && !first.geodetic.has_value()) {
    return unfit(absl::StrCat(
        "takes geodetic positions; ", file_,
        " holds local ones; --frame geodetic takes x as longitude and y as "
        "latitude in degrees"));
  }
  if (!geodetic && first.geodetic.has_value()) {
    return unfit(absl::StrCat(
        "takes local positions; ", file_,
        " holds latitude and longitude; --frame local makes them metres east "
        "and north of the first one"));
  }
  if (geodetic && options_.recording.tells_of_frames()) {
    return unfit(absl::StrCat("takes ", kGeodeticFrame));
  }
  if (IsFilter(vehicle_) &&
      (!first.error_transition.has_value() ||
       settings.state_space() == v1::STATE_SPACE_SPATIAL)) {
    return unfit(absl::StrCat(
        "needs an error transition with every pose; ", file_,
        settings.state_space() == v1::STATE_SPACE_SPATIAL
            ? " cannot have those of a spatial vehicle"
            : " has none (columns fxx, fxy, fxt, fyx, fyy, fyt, ftx, fty, "
              "ftt)"));
  }
  if (options_.append && options_.reader.frame == Frame::kLocal &&
      vehicle_.durable_sequence() > 0) {
    return unfit(
        "has poses already: --frame local with --append would count from "
        "another first position");
  }
  return absl::OkStatus();
}

std::string SampleSender::uncertainty() const {
  switch (source_) {
    case UncertaintyOptions::Source::kModel:
      return "model";
    case UncertaintyOptions::Source::kFile:
      return "file";
    case UncertaintyOptions::Source::kFixes:
      return "fixes";
  }
  return "";
}

void SampleSender::ChooseUncertainty() {
  source_ = options_.uncertainty.source;
  if (!options_.uncertainty_given) {
    source_ = ChooseSource(held_, IsFilter(vehicle_));
    const std::string text = ChoiceText(held_, source_);
    if (!text.empty()) {
      terminal_.progress << Printable(file_) << ": " << text << '\n';
    }
  }
  UncertaintyOptions uncertainty = options_.uncertainty;
  uncertainty.source = source_;
  claims_.emplace(uncertainty, file_);
  starts_.emplace(
      options_.recording, vehicle_.settings().state_space(),
      PosesTellOfFrames(vehicle_.settings().correlation_model(), uncertainty));
  starts_->BeginFile(file_);
  if (uncertainty.source == UncertaintyOptions::Source::kFixes &&
      vehicle_.settings().correlation_model() ==
          v1::CORRELATION_MODEL_DEAD_RECKONING) {
    const std::string name = Printable(vehicle_.name());
    terminal_.progress << name
                       << " takes errors as those of dead reckoning, and fixes "
                          "have independent ones: revisit vehicle update "
                       << name.substr(name.find('/') + 1)
                       << " --correlation-model independent\n";
  }
}

absl::Status SampleSender::CheckThatSessionIsFree() const {
  if (options_.session.empty()) return absl::OkStatus();
  const auto found = vehicle_.labels().find(SessionKey(options_.session));
  // The same command again goes on with the same first pose.
  if (found == vehicle_.labels().end() ||
      found->second.rfind(absl::StrCat(base_ + 1, "-"), 0) == 0) {
    return absl::OkStatus();
  }
  return LocalError(absl::FailedPreconditionError(absl::StrCat(
      "poses ", found->second, " of ", vehicle_.name(), " are the session ",
      options_.session, " already; choose another name")));
}

absl::Status SampleSender::KeepSession() {
  if (options_.session.empty()) return absl::OkStatus();
  const std::string key = SessionKey(options_.session);
  v1::UpdateVehicleRequest request;
  request.mutable_vehicle()->set_name(vehicle_.name());
  (*request.mutable_vehicle()->mutable_labels())[key] =
      absl::StrCat(base_ + 1, "-", base_ + taken_);
  request.mutable_update_mask()->add_paths(absl::StrCat("labels.", key));
  return Client(channel_).UpdateVehicle(request).status();
}

// Poses that go on in the same frame begin as uncertain as the last one is.
absl::Status SampleSender::ContinueBehindStored() {
  if (!options_.append || already_durable_ == 0) return absl::OkStatus();
  v1::ListPosesRequest request;
  request.set_parent(vehicle_.name());
  request.set_first_sequence(std::max<std::uint64_t>(already_durable_, 2) - 1);
  request.set_page_size(2);
  request.set_view(v1::POSE_VIEW_AS_SENT);
  const auto stored = Client(channel_).ListPoses(request);
  if (!stored.ok()) return stored.status();
  const LocalFrame frame(vehicle_.settings());
  std::optional<RecordingStarts::Place> before;
  for (const v1::Pose& one : stored->poses()) {
    if (!one.has_local()) return absl::OkStatus();
    const LocalPose pose = frame.Localize(one);
    RecordingStarts::Place place;
    place.pose = {pose.position[0], pose.position[1], pose.heading};
    if (pose.stamp) {
      place.time_nanoseconds =
          pose.stamp->seconds() * 1'000'000'000 + pose.stamp->nanos();
    }
    if (one.sequence() != already_durable_) {
      before = place;
      continue;
    }
    const StateMatrix& c = pose.covariance;
    claims_->ContinueFrom(place.pose, {c[0], c[1], c[3], c[5], c[7], c[15]});
    starts_->ContinueFrom(before, place);
  }
  return absl::OkStatus();
}

absl::Status SampleSender::Open() {
  const Sample& first = held_.front();
  if (!options_.uncertainty_given) {
    const absl::Status known =
        CheckThatErrorsAreKnown(file_, first, options_.reader.frame);
    if (!known.ok()) return LocalError(known);
  }
  auto vehicle = GetOrCreate(first);
  if (!vehicle.ok()) return vehicle.status();
  vehicle_ = *std::move(vehicle);
  if (absl::Status status = CheckThatSamplesFit(first); !status.ok()) {
    return status;
  }
  ChooseUncertainty();
  stream_ = std::make_unique<PoseStream>(channel_, vehicle_.name(),
                                         MakeStreamOptions(options_, vehicle_),
                                         callbacks_);
  interrupt_.emplace(stream_.get(), vehicle_.name(), options_.append,
                     terminal_);
  const auto durable = stream_->WaitUntilOpened();
  if (!durable.ok()) return WithPartialHint(durable.status());
  already_durable_ = *durable;
  if (options_.append) base_ = *durable;
  if (absl::Status status = CheckThatSessionIsFree(); !status.ok()) {
    return status;
  }
  return ContinueBehindStored();
}

void SampleSender::Send(const Sample& sample) {
  if (!status_.ok()) return;
  const std::uint64_t sequence = base_ + ++sent_;
  auto made = MakeNextPose(
      sample, vehicle_.settings().state_space(), sequence, &*starts_, &*claims_,
      [this](const std::string& note) { progress_.Note(note); });
  if (!made.ok()) {
    status_ = LocalError(made.status());
    return;
  }
  // The last durable pose is sent again, for the server to compare it.
  if (!options_.append && sequence < already_durable_) return;
  v1::Pose* pose = batch_.add_poses();
  *pose = *std::move(made);
  // A filter that begins anew has no transition to tell.
  if (IsFilter(vehicle_) && sequence > 1 && !pose->has_recording_start()) {
    if (!sample.error_transition.has_value()) {
      status_ = LocalError(absl::InvalidArgumentError(absl::StrCat(
          file_, ":", sample.line,
          ": expected an error transition, as the vehicle needs with every "
          "pose")));
      return;
    }
    AddErrorTransition(sample, pose);
  }
  if (batch_.poses_size() >= options_.batch_poses) Flush();
}

void SampleSender::Flush() {
  if (!status_.ok() || batch_.poses_size() == 0) return;
  status_ = stream_->Append(std::move(batch_));
  batch_.Clear();
}

}  // namespace revisit::client
