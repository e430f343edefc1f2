// revisit export
#ifndef REVISIT_CLIENT_CLI_COMMANDS_EXPORT_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_EXPORT_COMMAND_H_

#include <string>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"
#include "revisit/v1/pose_graph_service.pb.h"

namespace revisit::client {

void AddExportCommand(const Command& program);

enum class ExportFormat {
  // One JSON object per line: {"vehicle": ...} once, then {"node": ...} for
  // every node by index, then {"edge": ...} for every edge; the values are
  // protobuf JSON of revisit.v1.Vehicle, Node and Edge.
  kJsonLines,
  // A header line, then one line per node: index,sequence,fraction,t_s,
  // travelled_m,x_m,y_m,z_m,heading_rad and the upper triangle by rows of the
  // covariance of (x, y, z, heading): cxx,cxy,cxz,cxh,cyy,cyz,cyh,czz,czh,chh.
  // t_s is empty without a stamp, and so are the columns of z's covariance
  // where the state has no z.
  kNodesCsv,
  // A header line, then one line per edge: from_index,to_index,kind with kind
  // consecutive or loop_closure.
  kEdgesCsv,
  // All poses, each in the vehicle's local frame: see trajectory_text.h and
  // g2o_text.h.
  kTum,
  kKitti,
  kCsv,
  kG2o,
  // See map_geojson.h.
  kGeoJson,
};

struct ExportOptions {
  std::string vehicle;
  ExportFormat format = ExportFormat::kJsonLines;
  // The view that kTum, kKitti and kCsv have; a kG2o has both.
  v1::PoseView view = v1::POSE_VIEW_CURRENT;
  // The export goes to the terminal if this is empty.
  std::string output;
};

// Prints numbers so that reading them gives the same bits. An existing file is
// replaced when the export is complete, and only then.
absl::Status RunExport(const Client& client, const ExportOptions& options,
                       const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_EXPORT_COMMAND_H_
