#include "client/cli/commands/poses_command.h"

#include <algorithm>
#include <memory>
#include <optional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/answers/deviation_text.h"
#include "client/answers/names.h"
#include "client/answers/pages.h"
#include "client/cli/commands/shared_flags.h"
#include "client/formats/axes.h"
#include "client/terminal/output_file.h"
#include "google/protobuf/util/time_util.h"

namespace revisit::client {
namespace {

// Prints pages of poses as they come.
class PosePrinter {
 public:
  explicit PosePrinter(const Terminal& terminal) : terminal_(terminal) {
    if (terminal_.json()) terminal_.out << "{\"poses\": [";
  }

  void Print(const v1::ListPosesResponse& page, std::uint64_t last) {
    Table table = MakeTable(page);
    for (const v1::Pose& pose : page.poses()) {
      if (pose.sequence() > last) break;
      if (terminal_.json()) {
        terminal_.out << (first_ ? "\n" : ",\n") << ToJson(pose, false);
      } else {
        table.AddRow(Cells(pose));
      }
      first_ = false;
    }
    if (terminal_.json()) return;
    if (!table.empty() || !titles_printed_) {
      table.Print(terminal_.out, terminal_.width, !titles_printed_);
    }
    titles_printed_ = true;
  }

  void Finish() {
    if (terminal_.json()) terminal_.out << (first_ ? "]}\n" : "\n]}\n");
  }

 private:
  // All pages have the columns of the first.
  Table MakeTable(const v1::ListPosesResponse& page) {
    using Align = Table::Align;
    if (!titles_printed_) {
      geodetic_ = !page.poses().empty() && page.poses(0).has_geodetic();
    }
    std::vector<Table::Column> columns = {
        {"SEQUENCE", Align::kRight},
        {"STAMP", Align::kLeft, 24},
        {geodetic_ ? "LAT deg" : "X m", Align::kRight, 11},
        {geodetic_ ? "LON deg" : "Y m", Align::kRight, 11},
        {geodetic_ ? "HEIGHT m" : "Z m", Align::kRight, 8},
        {"YAW rad", Align::kRight, 8}};
    if (terminal_.wide()) {
      for (const char* title : {"SD X m", "SD Y m", "SD Z m"}) {
        columns.push_back({title, Align::kRight, 9});
      }
      columns.push_back({"SD YAW rad", Align::kRight});
      for (const char* title : {"QX", "QY", "QZ", "QW"}) {
        columns.push_back({title, Align::kRight, 9});
      }
    }
    return Table(std::move(columns));
  }

  std::vector<std::string> Cells(const v1::Pose& pose) const {
    std::vector<std::string> cells = {
        absl::StrCat(pose.sequence()),
        pose.has_stamp()
            ? google::protobuf::util::TimeUtil::ToString(pose.stamp())
            : "-"};
    if (pose.has_geodetic()) {
      const v1::GeodeticPosition& position = pose.geodetic();
      cells.push_back(Fixed(position.latitude_degrees(), 8));
      cells.push_back(Fixed(position.longitude_degrees(), 8));
      cells.push_back(Fixed(position.height_meters(), 3));
    } else {
      const v1::LocalPosition& position = pose.local();
      cells.push_back(Fixed(position.x_meters(), 3));
      cells.push_back(Fixed(position.y_meters(), 3));
      cells.push_back(Fixed(position.z_meters(), 3));
    }
    const v1::Quaternion& q = pose.quaternion();
    cells.push_back(Fixed(pose.has_quaternion()
                              ? HeadingOf({q.x(), q.y(), q.z(), q.w()})
                              : pose.heading_radians(),
                          5));
    if (terminal_.wide()) AddWideCells(pose, &cells);
    return cells;
  }

  static void AddWideCells(const v1::Pose& pose,
                           std::vector<std::string>* cells) {
    for (std::string& deviation : DeviationTexts(pose.covariance())) {
      cells->push_back(std::move(deviation));
    }
    const v1::Quaternion& q = pose.quaternion();
    for (const double part : {q.x(), q.y(), q.z(), q.w()}) {
      cells->push_back(pose.has_quaternion() ? Fixed(part, 6) : "-");
    }
  }

  const Terminal& terminal_;
  bool first_ = true;
  bool titles_printed_ = false;
  bool geodetic_ = false;
};

}  // namespace

void AddPosesCommand(const Command& program) {
  const Command poses =
      program.AddCommand({"poses", "Lists the stored poses.", "", ""});
  const Command list = poses.AddCommand(
      {"list",
       "Lists a vehicle's poses, as they were last revised or as they were "
       "sent.",
       "-o wide shows standard deviations and quaternions too; -o json has "
       "the poses whole, with their covariances.",
       "  revisit poses list shuttle-7\n"
       "  revisit poses list shuttle-7 --from 1000 --to 1010 --json"});
  const auto options = std::make_shared<PosesListOptions>();
  AddVehicleName(list, &options->vehicle);
  list.AddWholeNumber("--from", kSequences, &options->from,
                      "Sequence of the first pose (1)");
  list.AddWholeNumber("--to", kSequences, &options->to,
                      "Sequence of the last pose (the newest)");
  AddPoseView(list, &options->view);
  const Run run = [options](const Connection& server,
                            const Terminal& terminal) {
    return RunPosesList(server.client, *options, terminal);
  };
  list.AlsoPrints({OutputFormat::kWide});
  list.Runs(run, [options]() -> std::string {
    return options->from > options->to
               ? absl::StrCat("--from: got ", options->from,
                              "; allowed is at most --to, ", options->to)
               : "";
  });
}

absl::Status RunPosesList(const Client& client, const PosesListOptions& options,
                          const Terminal& terminal) {
  constexpr std::uint64_t kPage = 1000;
  v1::ListPosesRequest request;
  request.set_parent(VehicleName(options.vehicle));
  request.set_first_sequence(options.from);
  request.set_view(options.view);
  request.set_page_size(static_cast<std::int32_t>(
      std::min(kPage - 1, options.to - options.from) + 1));
  // Made for the first page, so that an error before it stands alone.
  std::optional<PosePrinter> printer;
  const absl::Status status = VisitPages(
      request,
      [&](const v1::ListPosesRequest& asked) {
        return client.ListPoses(asked);
      },
      [](const v1::ListPosesResponse& page) -> const auto& {
        return page.poses();
      },
      [&](const v1::ListPosesResponse& page) -> absl::StatusOr<bool> {
        if (!printer.has_value()) printer.emplace(terminal);
        printer->Print(page, options.to);
        if (absl::Status output = CheckOutput(terminal.out); !output.ok()) {
          return output;
        }
        return page.poses().empty() ||
               page.poses().rbegin()->sequence() < options.to;
      });
  if (!status.ok()) return status;
  printer->Finish();
  return absl::OkStatus();
}

}  // namespace revisit::client
