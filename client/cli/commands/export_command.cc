#include "client/cli/commands/export_command.h"

#include <functional>
#include <memory>

#include "absl/strings/str_cat.h"
#include "client/answers/exact_text.h"
#include "client/answers/names.h"
#include "client/cli/commands/shared_flags.h"
#include "client/map/map_geojson.h"
#include "client/map/server_map.h"
#include "client/revisit/printable_text.h"
#include "client/terminal/output_file.h"
#include "client/trajectory/g2o_text.h"
#include "client/trajectory/local_pose.h"
#include "client/trajectory/stored_poses.h"
#include "client/trajectory/trajectory_text.h"

namespace revisit::client {
namespace {

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
    default:
      return;
  }
}

absl::Status ExportGraph(const Client& client, const std::string& vehicle,
                         ExportFormat format, v1::PoseView view,
                         std::ostream& out) {
  v1::ExportPoseGraphRequest request;
  request.set_vehicle(vehicle);
  request.set_view(view);
  WriteHeader(format, out);
  return client.ExportPoseGraph(request,
                                [&](const v1::ExportPoseGraphResponse& part) {
                                  WritePart(part, format, out);
                                  return CheckOutput(out);
                                });
}

// Notes a change of the vehicle since it was read: the pages of its poses are
// not of one moment.
absl::Status NoteChange(const Client& client, const v1::Vehicle& vehicle,
                        Progress* progress) {
  const auto after = ReadVehicle(client, vehicle.name());
  if (!after.ok()) return after.status();
  if (after->revision() != vehicle.revision()) {
    progress->Note(absl::StrCat(
        "changed meanwhile, from revision ", vehicle.revision(), " to ",
        after->revision(), ": some poses may be from before, some from after"));
  }
  return absl::OkStatus();
}

// Calls `write` for each pose, in the vehicle's local frame.
absl::Status ExportPoses(
    const Client& client, const v1::Vehicle& vehicle, v1::PoseView view,
    const Terminal& terminal,
    const std::function<absl::Status(const LocalPose&)>& write) {
  const LocalFrame frame(vehicle.settings());
  Progress progress(terminal, vehicle.name(), vehicle.durable_sequence(),
                    "poses");
  const absl::Status read =
      VisitPoses(client, vehicle.name(), view, [&](const v1::Pose& pose) {
        progress.Update(pose.sequence());
        return write(frame.Localize(pose));
      });
  if (!read.ok()) return read;
  return NoteChange(client, vehicle, &progress);
}

absl::Status ExportTum(const Client& client, const v1::Vehicle& vehicle,
                       v1::PoseView view, const Terminal& terminal,
                       std::ostream& out) {
  const auto write = [&](const LocalPose& pose) {
    if (!pose.stamp.has_value()) {
      return LocalError(absl::FailedPreconditionError(absl::StrCat(
          vehicle.name(), ": pose ", pose.sequence,
          " has no stamp, and a line of TUM begins with one; --format g2o, "
          "kitti and csv need none")));
    }
    WriteTumLine(pose, out);
    return CheckOutput(out);
  };
  return ExportPoses(client, vehicle, view, terminal, write);
}

void TellCounts(const v1::Vehicle& vehicle, const G2oWriter::Counts& counts,
                const Terminal& terminal) {
  const std::string name = Printable(vehicle.name());
  terminal.progress << name << ": revision " << vehicle.revision()
                    << ", poses: " << counts.poses
                    << ", jumps: " << counts.jumps
                    << ", loop closures: " << counts.closures
                    << ", without a measurement: " << counts.unmeasured_closures
                    << '\n';
  if (counts.recordings > 0) {
    terminal.progress << name
                      << ": recordings behind the first: " << counts.recordings
                      << ", without an edge to them: " << counts.untied
                      << "; what an optimiser makes of their poses is in one "
                         "frame: revise --common-frame\n";
  }
  if (counts.gaps > 0) {
    terminal.progress << name << ": " << counts.gaps
                      << " steps lead over dropped poses; their edges are as "
                         "uncertain as both ends\n";
  }
  if (counts.raised > 0) {
    terminal.progress
        << name << ": the covariances of " << counts.raised
        << " poses grow by less than 1 mm or 0.1 mrad from the pose before; "
           "their edges have that much\n";
  }
}

absl::Status ExportG2o(const Client& client, const v1::Vehicle& vehicle,
                       const Terminal& terminal, std::ostream& out) {
  // Closures first: their poses are then among those that are read.
  const auto closures = ReadLoopClosures(client, vehicle.name());
  if (!closures.ok()) return closures.status();
  const auto recordings = ReadRecordings(client, vehicle.name());
  if (!recordings.ok()) return recordings.status();
  // Optimisers begin from vertices, so these are in one frame, as far as it is
  // known: that of the last recording.
  const auto in_common_frame = [&](LocalPose pose) {
    const v1::Recording* of = RecordingOf(*recordings, pose.sequence);
    if (of == nullptr || !of->has_frame_pose() ||
        of->frame_state() == v1::FRAME_STATE_SAME) {
      return pose;
    }
    return InOuterFrame(pose, of->frame_pose());
  };
  G2oWriter writer(vehicle.settings(), *closures, &out);
  const LocalFrame frame(vehicle.settings());
  Progress progress(terminal, vehicle.name(), vehicle.durable_sequence(),
                    "poses");
  const absl::Status read =
      VisitBothViews(client, vehicle.name(),
                     [&](const v1::Pose& current, const v1::Pose& as_sent) {
                       progress.Update(current.sequence());
                       writer.Add(in_common_frame(frame.Localize(current)),
                                  frame.Localize(as_sent));
                       return CheckOutput(out);
                     });
  if (!read.ok()) return read;
  if (absl::Status noted = NoteChange(client, vehicle, &progress);
      !noted.ok()) {
    return noted;
  }
  writer.AddClosures();
  TellCounts(vehicle, writer.counts(), terminal);
  return CheckOutput(out);
}

absl::Status ExportGeoJson(const Client& client, const std::string& vehicle,
                           const Terminal& terminal, std::ostream& out) {
  const auto map = ReadServerMap(client, vehicle, terminal);
  if (!map.ok()) return map.status();
  if (absl::Status fits = CheckGeodetic(map->vehicle); !fits.ok()) return fits;
  WriteGeoJson(*map, out);
  return CheckOutput(out);
}

absl::Status Export(const Client& client, const ExportOptions& options,
                    const Terminal& terminal, std::ostream& out) {
  const std::string name = VehicleName(options.vehicle);
  switch (options.format) {
    case ExportFormat::kJsonLines:
    case ExportFormat::kNodesCsv:
    case ExportFormat::kEdgesCsv:
      return ExportGraph(client, name, options.format, options.view, out);
    default:
      break;
  }
  if (options.format == ExportFormat::kGeoJson) {
    return ExportGeoJson(client, name, terminal, out);
  }
  const auto vehicle = ReadVehicle(client, name);
  if (!vehicle.ok()) return vehicle.status();
  if (options.format == ExportFormat::kTum) {
    return ExportTum(client, *vehicle, options.view, terminal, out);
  }
  if (options.format == ExportFormat::kG2o) {
    return ExportG2o(client, *vehicle, terminal, out);
  }
  const bool csv = options.format == ExportFormat::kCsv;
  const bool spatial =
      vehicle->settings().state_space() == v1::STATE_SPACE_SPATIAL;
  if (csv) WriteCsvHeader(out);
  const auto write = [&](const LocalPose& pose) {
    if (csv) {
      WriteCsvLine(pose, spatial, out);
    } else {
      WriteKittiLine(pose, out);
    }
    return CheckOutput(out);
  };
  return ExportPoses(client, *vehicle, options.view, terminal, write);
}

constexpr char kExportDetails[] =
    "The poses, as they were last revised or, with --view as-sent, as they "
    "were sent, in the\n"
    "local frame (that of a geodetic vehicle is East-North-Up at its "
    "origin):\n"
    "  tum        t x y z qx qy qz qw, for evo and other viewers\n"
    "  kitti      twelve numbers, the body's axes being forward, left, up; "
    "no times\n"
    "  csv        with a header line: "
    "sequence,t_s,est_x,est_y,est_z,est_yaw,"
    "qx,qy,qz,qw\n"
    "             and the covariance's upper triangle\n"
    "  g2o        for optimisers: VERTEX_SE2 or, for spatial vehicles, "
    "VERTEX_SE3:QUAT, whose\n"
    "             ids are sequences; an edge from each pose to the next "
    "as they were\n"
    "             sent, with the uncertainty that the step adds; an edge for "
    "each loop closure,\n"
    "             as measured. Recordings are in the frame of the last one, as "
    "far as it is\n"
    "             known, and joined by an edge with what was said of the gap "
    "or of their datums\n"
    "The graph of nodes, spaced evenly, on which searches are made; with "
    "--view as-sent, of nodes\n"
    "along the path as it was sent:\n"
    "  jsonl      a JSON object a line: {\"vehicle\": ...}, then {\"node\": "
    "...} for each node,\n"
    "             then {\"edge\": ...} for each edge; protobuf JSON\n"
    "  nodes-csv  with a header line: index,sequence,fraction,t_s,"
    "travelled_m,x_m,y_m,z_m,\n"
    "             heading_rad and the covariance's upper triangle\n"
    "  edges-csv  the same: from_index,to_index,kind\n"
    "  geojson    for vehicles that stream geodetic positions: the "
    "trajectory, loop closures\n"
    "             and rejected candidates in longitude and latitude\n"
    "Numbers read back to the same bits. revisit revise brings optimised "
    "poses back. In tum, a comment marks where a recording begins; tum, kitti "
    "and csv have each pose in the frame of its own recording.";

constexpr char kExportExamples[] =
    "  revisit export shuttle-7 > graph.jsonl\n"
    "  revisit export shuttle-7 --format g2o --output shuttle-7.g2o\n"
    "  revisit export shuttle-7 --format tum --output shuttle-7.tum";

}  // namespace

void AddExportCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"export", "Writes out a vehicle's poses or its pose graph.",
       kExportDetails, kExportExamples});
  const Words formats = {
      {"jsonl", static_cast<int>(ExportFormat::kJsonLines)},
      {"nodes-csv", static_cast<int>(ExportFormat::kNodesCsv)},
      {"edges-csv", static_cast<int>(ExportFormat::kEdgesCsv)},
      {"tum", static_cast<int>(ExportFormat::kTum)},
      {"kitti", static_cast<int>(ExportFormat::kKitti)},
      {"csv", static_cast<int>(ExportFormat::kCsv)},
      {"g2o", static_cast<int>(ExportFormat::kG2o)},
      {"geojson", static_cast<int>(ExportFormat::kGeoJson)}};
  const auto options = std::make_shared<ExportOptions>();
  AddVehicleName(command, &options->vehicle);
  command.AddChoice("--format", formats, &options->format,
                    "What to write (jsonl)");
  AddPoseView(command, &options->view);
  command.AddText("--output", "FILE", &options->output,
                  "File to write instead of standard output");
  const Check check = [command, options]() -> std::string {
    const ExportFormat format = options->format;
    if (command.AsksForJson() && format != ExportFormat::kJsonLines) {
      return "-o json, --json: go with --format jsonl only";
    }
    if (command.Given("--view") &&
        (format == ExportFormat::kG2o || format == ExportFormat::kGeoJson)) {
      return "--view: goes with neither --format g2o, which has both, nor "
             "geojson";
    }
    return "";
  };
  const Run run = [options](const Connection& server,
                            const Terminal& terminal) {
    return RunExport(server.client, *options, terminal);
  };
  command.Runs(run, check);
}

absl::Status RunExport(const Client& client, const ExportOptions& options,
                       const Terminal& terminal) {
  return WriteTo(options.output, terminal.out, [&](std::ostream& out) {
    return Export(client, options, terminal, out);
  });
}

}  // namespace revisit::client
