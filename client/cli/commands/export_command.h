// revisit export
#ifndef REVISIT_CLIENT_CLI_COMMANDS_EXPORT_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_EXPORT_COMMAND_H_

#include <string>

#include "absl/status/status.h"
#include "client/cli/console.h"
#include "client/revisit/client.h"

namespace revisit::client {

enum class ExportFormat {
  // A JSON object a line: {"vehicle": ...} once, then {"node": ...} for every
  // node by
  // index, then {"edge": ...} for every edge; the values are protobuf JSON of
  // revisit.v1.Vehicle, Node and Edge.
  kJsonLines,
  // A header line, then a line a node:
  // index,sequence,fraction,t_s,travelled_m,x_m,
  // y_m,z_m,heading_rad and the upper triangle by rows of the covariance of
  // (x, y, z, heading): cxx,cxy,cxz,cxh,cyy,cyz,cyh,czz,czh,chh. Without a
  // stamp t_s
  // is empty; without z in the state so are the columns of z's covariance.
  kNodesCsv,
  // A header line, then a line an edge: from_index,to_index,kind with kind
  // consecutive or loop_closure.
  kEdgesCsv,
};

struct ExportOptions {
  std::string vehicle;
  ExportFormat format = ExportFormat::kJsonLines;
  // Empty: to the console.
  std::string output;
};

// Numbers are printed so that reading them gives the same bits. A file that is
// there already is replaced when the export is complete, and only then.
absl::Status RunExport(const Client& client, const ExportOptions& options,
                       const Console& console);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_EXPORT_COMMAND_H_
