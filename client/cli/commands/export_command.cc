#include "client/cli/commands/export_command.h"

#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <memory>
#include <system_error>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/cli/commands/shared_flags.h"
#include "client/cli/exact_text.h"
#include "client/cli/names.h"

namespace revisit::client {
namespace {

namespace fs = std::filesystem;

void WriteNodeCsv(const v1::Node& node, std::ostream& out) {
  out << node.index() << ',' << node.sequence() << ',' << Exact(node.fraction())
      << ',' << (node.has_stamp() ? StampSeconds(node.stamp()) : "") << ','
      << Exact(node.travelled_meters()) << ',' << Exact(node.pose().x_meters())
      << ',' << Exact(node.pose().y_meters()) << ','
      << Exact(node.pose().z_meters()) << ','
      << Exact(node.pose().heading_radians());
  const auto& v = node.covariance().values();
  const bool planar =
      node.covariance().form() == v1::COVARIANCE_FORM_PLANAR_6 && v.size() == 6;
  const bool spatial =
      node.covariance().form() == v1::COVARIANCE_FORM_SPATIAL_10 &&
      v.size() == 10;
  // The index of the planar value in each column; -1 for none.
  constexpr int kPlanarColumns[10] = {0, 1, -1, 2, 3, -1, 4, -1, -1, 5};
  for (int i = 0; i < 10; ++i) {
    out << ',';
    const int column = planar ? kPlanarColumns[i] : i;
    if ((planar || spatial) && column >= 0) out << Exact(v[column]);
  }
  out << '\n';
}

void WriteHeader(ExportFormat format, std::ostream& out) {
  if (format == ExportFormat::kNodesCsv) {
    out << "index,sequence,fraction,t_s,travelled_m,x_m,y_m,z_m,heading_rad,"
           "cxx,cxy,cxz,cxh,cyy,cyz,cyh,czz,czh,chh\n";
  } else if (format == ExportFormat::kEdgesCsv) {
    out << "from_index,to_index,kind\n";
  }
}

void WritePart(const v1::ExportPoseGraphResponse& part, ExportFormat format,
               std::ostream& out) {
  switch (format) {
    case ExportFormat::kJsonLines:
      if (part.has_vehicle()) {
        out << "{\"vehicle\":" << ToJson(part.vehicle(), false) << "}\n";
      }
      for (const v1::Node& node : part.nodes()) {
        out << "{\"node\":" << ToJson(node, false) << "}\n";
      }
      for (const v1::Edge& edge : part.edges()) {
        out << "{\"edge\":" << ToJson(edge, false) << "}\n";
      }
      return;
    case ExportFormat::kNodesCsv:
      for (const v1::Node& node : part.nodes()) WriteNodeCsv(node, out);
      return;
    case ExportFormat::kEdgesCsv:
      for (const v1::Edge& edge : part.edges()) {
        out << edge.from_index() << ',' << edge.to_index() << ','
            << (edge.kind() == v1::EDGE_KIND_LOOP_CLOSURE ? "loop_closure"
                                                          : "consecutive")
            << '\n';
      }
      return;
  }
}

// A file that gets its name when it is whole: a file of this name stays as it
// is until then. A pipe or a device is written to as the parts come.
class OutputFile {
 public:
  explicit OutputFile(std::string path) : path_(std::move(path)) {}

  ~OutputFile() {
    if (!aside_.empty()) std::remove(aside_.c_str());
  }

  OutputFile(const OutputFile&) = delete;
  OutputFile& operator=(const OutputFile&) = delete;

  std::ostream& stream() { return stream_; }

  absl::Status Open() {
    std::error_code error;
    const fs::file_status before = fs::status(path_, error);
    // A name in /dev may lead to a file that somebody holds open.
    if (path_.rfind("/dev/", 0) == 0 ||
        (fs::exists(before) && !fs::is_regular_file(before))) {
      stream_.open(path_, std::ios::binary);
      return stream_ ? absl::OkStatus() : Error();
    }
    if (fs::exists(before)) {
      // A file that may not be written to is not replaced either.
      if (access(path_.c_str(), W_OK) != 0) return Error();
      // A link goes on leading to it.
      path_ = fs::canonical(path_, error).string();
    }
    aside_ = absl::StrCat(path_, ".", getpid(), ".part");
    stream_.open(aside_, std::ios::binary | std::ios::trunc);
    if (!stream_) return Error();
    if (fs::exists(before)) {
      fs::permissions(aside_, before.permissions(), error);
    }
    return absl::OkStatus();
  }

  absl::Status Finish() {
    stream_.close();
    if (!stream_) return Error();
    if (!aside_.empty() && std::rename(aside_.c_str(), path_.c_str()) != 0) {
      return Error();
    }
    aside_.clear();
    return absl::OkStatus();
  }

 private:
  absl::Status Error() const {
    return LocalError(
        absl::UnknownError(absl::StrCat(path_, ": ", std::strerror(errno))));
  }

  std::string path_;
  // The unfinished file, to be removed; empty if there is none.
  std::string aside_;
  std::ofstream stream_;
};

}  // namespace

void AddExportCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"export", "Writes out a vehicle's pose graph.",
       "Formats:\n"
       "  jsonl      a JSON object a line: {\"vehicle\": ...}, then {\"node\": "
       "...} for each node,\n"
       "             then {\"edge\": ...} for each edge; protobuf JSON\n"
       "  nodes-csv  comma-separated with a header line: index,sequence,"
       "fraction,t_s,\n"
       "             travelled_m,x_m,y_m,z_m,heading_rad and the covariance's "
       "upper triangle\n"
       "  edges-csv  the same: from_index,to_index,kind\n"
       "Numbers read back to the same bits.",
       "  revisit export shuttle-7 > graph.jsonl\n"
       "  revisit export shuttle-7 --format nodes-csv --output nodes.csv"});
  const Words formats = {
      {"jsonl", static_cast<int>(ExportFormat::kJsonLines)},
      {"nodes-csv", static_cast<int>(ExportFormat::kNodesCsv)},
      {"edges-csv", static_cast<int>(ExportFormat::kEdgesCsv)}};
  const auto options = std::make_shared<ExportOptions>();
  AddVehicleName(command, &options->vehicle);
  command.AddChoice("--format", formats, &options->format,
                    "What to write (jsonl)");
  command.AddText("--output", "FILE", &options->output,
                  "File to write instead of standard output");
  const Check check = [command, options]() -> std::string {
    return command.Given("--json") &&
                   options->format != ExportFormat::kJsonLines
               ? "--json: goes with --format jsonl only"
               : "";
  };
  const Run run = [options](const Connection& server, const Console& console) {
    return RunExport(server.client, *options, console);
  };
  command.Runs(run, check);
}

absl::Status RunExport(const Client& client, const ExportOptions& options,
                       const Console& console) {
  v1::ExportPoseGraphRequest request;
  request.set_vehicle(VehicleName(options.vehicle));
  OutputFile file(options.output);
  const bool to_file = !options.output.empty();
  if (to_file) {
    if (absl::Status opened = file.Open(); !opened.ok()) return opened;
  }
  std::ostream& out = to_file ? file.stream() : console.out;
  WriteHeader(options.format, out);
  const absl::Status status = client.ExportPoseGraph(
      request, [&](const v1::ExportPoseGraphResponse& part) {
        WritePart(part, options.format, out);
        if (!out.good()) {
          return LocalError(absl::UnknownError("the output cannot be written"));
        }
        return absl::OkStatus();
      });
  if (!status.ok()) return status;
  out.flush();
  return to_file ? file.Finish() : absl::OkStatus();
}

}  // namespace revisit::client
