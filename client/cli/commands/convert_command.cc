#include "client/cli/commands/convert_command.h"

#include <algorithm>
#include <cstddef>
#include <deque>
#include <memory>
#include <optional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/cli/commands/reader_flags.h"
#include "client/cli/commands/shared_flags.h"
#include "client/formats/text_lines.h"
#include "client/terminal/output_file.h"
#include "client/trajectory/claim_choice.h"
#include "client/trajectory/drive_poses.h"
#include "client/trajectory/g2o_text.h"
#include "client/trajectory/local_pose.h"
#include "client/trajectory/trajectory_text.h"
#include "google/protobuf/util/delimited_message_util.h"
#include "revisit/v1/pose_graph_service.pb.h"

namespace revisit::client {
namespace {

// Poses of one message of kMessages.
constexpr int kBatchPoses = 1000;
// Samples that are looked at before the first pose is written.
constexpr std::size_t kMostHeld = 4096;

// Takes one pose after the other.
class PoseWriter {
 public:
  virtual ~PoseWriter() = default;
  virtual absl::Status Write(const v1::Pose& pose) = 0;
  // Writes what has been gathered.
  virtual void Flush() {}
};

class JsonLinesWriter : public PoseWriter {
 public:
  explicit JsonLinesWriter(std::ostream* out) : out_(*out) {}

  absl::Status Write(const v1::Pose& pose) override {
    out_ << ToJson(pose, false) << '\n';
    return CheckOutput(out_);
  }
  void Flush() override { out_.flush(); }

 private:
  std::ostream& out_;
};

class MessagesWriter : public PoseWriter {
 public:
  explicit MessagesWriter(std::ostream* out) : out_(*out) {}

  absl::Status Write(const v1::Pose& pose) override {
    *batch_.add_poses() = pose;
    if (batch_.poses_size() >= kBatchPoses) Flush();
    return CheckOutput(out_);
  }
  void Flush() override {
    if (batch_.poses_size() == 0) return;
    google::protobuf::util::SerializeDelimitedToOstream(batch_, &out_);
    batch_.Clear();
    out_.flush();
  }

 private:
  std::ostream& out_;
  v1::PoseBatch batch_;
};

// The formats that are in a local frame.
class LocalWriter : public PoseWriter {
 public:
  LocalWriter(const ConvertOptions& options, std::ostream* out)
      : options_(options), out_(*out) {}

  absl::Status Write(const v1::Pose& pose) override {
    if (!frame_.has_value()) Begin(pose);
    WriteLocal(frame_->Localize(pose));
    return CheckOutput(out_);
  }
  void Flush() override { out_.flush(); }

 private:
  void Begin(const v1::Pose& first) {
    settings_.set_state_space(options_.state_space);
    settings_.set_correlation_model(options_.correlation_model);
    if (first.has_geodetic()) {
      settings_.set_coordinate_frame(v1::COORDINATE_FRAME_GEODETIC);
      *settings_.mutable_geodetic_origin() = first.geodetic();
    }
    frame_.emplace(settings_);
    if (options_.format == ConvertFormat::kCsv) WriteCsvHeader(out_);
    if (options_.format == ConvertFormat::kG2o) {
      g2o_.emplace(settings_, no_closures_, &out_);
    }
  }

  void WriteLocal(const LocalPose& pose) {
    if (g2o_.has_value()) {
      g2o_->Add(pose, /*as_sent=*/pose);
    } else if (options_.format == ConvertFormat::kTum) {
      WriteTumLine(pose, out_);
    } else if (options_.format == ConvertFormat::kKitti) {
      WriteKittiLine(pose, out_);
    } else {
      WriteCsvLine(pose, options_.state_space == v1::STATE_SPACE_SPATIAL, out_);
    }
  }

  const ConvertOptions& options_;
  std::ostream& out_;
  v1::VehicleSettings settings_;
  std::optional<LocalFrame> frame_;
  const std::vector<v1::LoopClosure> no_closures_;
  std::optional<G2oWriter> g2o_;
};

std::unique_ptr<PoseWriter> MakeWriter(const ConvertOptions& options,
                                       std::ostream* out) {
  switch (options.format) {
    case ConvertFormat::kJsonLines:
      return std::make_unique<JsonLinesWriter>(out);
    case ConvertFormat::kMessages:
      return std::make_unique<MessagesWriter>(out);
    default:
      return std::make_unique<LocalWriter>(options, out);
  }
}

// Makes poses of the samples of one file after the other. The first samples are
// held until it is known what uncertainty is claimed.
class Converter {
 public:
  Converter(const ConvertOptions& options, PoseWriter* writer,
            Progress* progress)
      : options_(options), writer_(*writer), progress_(*progress) {}

  // Writes the poses of a file, also those before an error of it.
  absl::Status Convert(const std::string& file) {
    absl::Status read = Read(file);
    absl::Status written = LetGo();
    writer_.Flush();
    return read.ok() ? written : read;
  }

  std::uint64_t poses() const { return poses_; }

 private:
  bool is_filter() const {
    return options_.correlation_model == v1::CORRELATION_MODEL_FILTER;
  }

  absl::Status Read(const std::string& file) {
    file_ = file;
    if (claims_.has_value()) claims_->BeginRecording(file);
    if (starts_.has_value()) starts_->BeginFile(file);
    const auto reader = OpenSamples(file, options_.reader);
    if (!reader.ok()) return reader.status();
    for (;;) {
      const auto sample = (*reader)->Next();
      if (!sample.ok()) return sample.status();
      if (!sample->has_value()) return absl::OkStatus();
      if (absl::Status taken = Take(**sample); !taken.ok()) return taken;
    }
  }

  absl::Status Take(const Sample& sample) {
    if (claims_.has_value()) return Write(sample);
    held_.push_back(sample);
    return held_.size() < kMostHeld ? absl::OkStatus() : LetGo();
  }

  absl::Status LetGo() {
    if (held_.empty()) return absl::OkStatus();
    if (absl::Status chosen = ChooseClaims(); !chosen.ok()) return chosen;
    absl::Status written;
    for (; written.ok() && !held_.empty(); held_.pop_front()) {
      written = Write(held_.front());
    }
    return written;
  }

  absl::Status ChooseClaims() {
    UncertaintyOptions uncertainty = options_.uncertainty;
    if (!options_.uncertainty_given) {
      if (absl::Status known = CheckThatErrorsAreKnown(file_, held_.front(),
                                                       options_.reader.frame);
          !known.ok()) {
        return known;
      }
      uncertainty.source = ChooseSource(held_, is_filter());
      const std::string text = ChoiceText(held_, uncertainty.source);
      if (!text.empty()) progress_.Note(text);
    }
    claims_.emplace(uncertainty, file_);
    if (held_.front().geodetic.has_value() &&
        options_.recording.tells_of_frames()) {
      return absl::InvalidArgumentError(
          absl::StrCat(file_, ": has ", kGeodeticFrame));
    }
    starts_.emplace(options_.recording, options_.state_space,
                    PosesTellOfFrames(options_.correlation_model, uncertainty));
    starts_->BeginFile(file_);
    return absl::OkStatus();
  }

  absl::Status Write(const Sample& sample) {
    auto made = MakeNextPose(
        sample, options_.state_space, ++poses_, &*starts_, &*claims_,
        [this](const std::string& note) { progress_.Note(note); });
    if (!made.ok()) return made.status();
    v1::Pose pose = *std::move(made);
    // A filter that begins anew has no transition to tell.
    if (is_filter() && poses_ > 1 && !pose.has_recording_start()) {
      if (!sample.error_transition.has_value()) {
        return absl::InvalidArgumentError(absl::StrCat(
            file_, ":", sample.line,
            ": expected an error transition, as --correlation-model filter "
            "needs with every pose"));
      }
      AddErrorTransition(sample, &pose);
    }
    if (options_.format == ConvertFormat::kTum && !pose.has_stamp()) {
      return absl::FailedPreconditionError(absl::StrCat(
          file_, ":", sample.line,
          ": no time, and a line of TUM begins with one; --times and --rate "
          "state times, and the other formats need none"));
    }
    progress_.Update(poses_);
    return writer_.Write(pose);
  }

  const ConvertOptions& options_;
  PoseWriter& writer_;
  Progress& progress_;
  std::string file_;
  std::deque<Sample> held_;
  std::optional<UncertaintyClaims> claims_;
  std::optional<RecordingStarts> starts_;
  std::uint64_t poses_ = 0;
};

void AddPoseFlags(const Command& command, ConvertOptions* options) {
  const Words formats = {
      {"csv", static_cast<int>(ConvertFormat::kCsv)},
      {"tum", static_cast<int>(ConvertFormat::kTum)},
      {"kitti", static_cast<int>(ConvertFormat::kKitti)},
      {"g2o", static_cast<int>(ConvertFormat::kG2o)},
      {"jsonl", static_cast<int>(ConvertFormat::kJsonLines)},
      {"messages", static_cast<int>(ConvertFormat::kMessages)}};
  command.AddChoice("--to", formats, &options->format, "What to write (csv)");
  command.AddText("--output", "FILE", &options->output,
                  "File to write instead of standard output");
  const Words spaces = {{"planar", v1::STATE_SPACE_PLANAR},
                        {"spatial", v1::STATE_SPACE_SPATIAL}};
  command.AddChoice("--state-space", spaces, &options->state_space,
                    "Of the vehicle that the poses are for (planar)");
  command.AddChoice("--correlation-model",
                    WordsOf(v1::CorrelationModel_descriptor()),
                    &options->correlation_model,
                    "Likewise (dead-reckoning); with filter, poses have the "
                    "file's error transitions");
}

std::string CheckOptions(const ConvertOptions& options) {
  if (options.correlation_model == v1::CORRELATION_MODEL_FILTER &&
      options.state_space == v1::STATE_SPACE_SPATIAL) {
    return "--correlation-model: files hold no error transitions of "
           "--state-space spatial";
  }
  const auto pipes =
      std::count(options.files.begin(), options.files.end(), "-");
  return pipes > 1 ? "FILE: the standard input can be read once only" : "";
}

}  // namespace

void AddConvertCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"convert", "Reads recordings and writes their poses, without a server.",
       "The poses are those that stream would send: pose i of all FILEs gets "
       "sequence i, and\n"
       "what looks like wrong axes, units or orders is refused.\n"
       "  csv        with a header line: "
       "sequence,t_s,est_x,est_y,est_z,est_yaw,"
       "qx,qy,qz,qw\n"
       "             and the covariance's upper triangle\n"
       "  tum        t x y z qx qy qz qw, for evo and other viewers\n"
       "  kitti      twelve numbers, the body's axes being forward, left, up; "
       "no times\n"
       "  g2o        vertices, and an edge from each pose to the next with the "
       "uncertainty that\n"
       "             the step adds\n"
       "  jsonl      a revisit.v1.Pose a line; protobuf JSON\n"
       "  messages   for programs: serialised revisit.v1.PoseBatch, each "
       "behind its size as a\n"
       "             varint\n"
       "csv, tum, kitti and g2o are in metres: latitude and longitude become "
       "east and north of\n"
       "the first position. Numbers read back to the same bits.",
       "  revisit convert poses.txt --axes camera --times times.txt\n"
       "  revisit convert drive.g2o --rate 10 --to tum --output drive.tum\n"
       "  revisit convert monday.gpx tuesday.gpx --to jsonl"});
  const auto options = std::make_shared<ConvertOptions>();
  command
      .AddTexts("FILE", "TEXT", &options->files,
                "Recordings, one after the other; - for the standard input")
      .Required();
  AddPoseFlags(command, options.get());
  AddRecording(command, &options->recording);
  AddReaderFlags(command, &options->reader);
  AddUncertainty(command, &options->uncertainty);
  const Check check = [command, options]() -> std::string {
    options->uncertainty_given = command.Given("--uncertainty");
    if (command.AsksForJson() && !command.Given("--to")) {
      options->format = ConvertFormat::kJsonLines;
    }
    return CheckOptions(*options);
  };
  command.RunsAlone(
      [options](const Terminal& terminal) {
        return RunConvert(*options, terminal);
      },
      check);
}

absl::Status RunConvert(const ConvertOptions& options,
                        const Terminal& terminal) {
  Progress progress(terminal, StemOf(options.files[0]), 0, "poses");
  return WriteTo(options.output, terminal.out, [&](std::ostream& out) {
    const std::unique_ptr<PoseWriter> writer = MakeWriter(options, &out);
    Converter converter(options, writer.get(), &progress);
    for (const std::string& file : options.files) {
      absl::Status converted = converter.Convert(file);
      if (!converted.ok()) return LocalError(converted);
    }
    if (converter.poses() == 0) {
      return LocalError(absl::InvalidArgumentError(
          absl::StrCat(options.files[0], ": the vehicle never moves")));
    }
    return CheckOutput(out);
  });
}

}  // namespace revisit::client
