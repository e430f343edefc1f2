// Columns of tables that tell where frames lie in another one.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_FRAME_COLUMNS_H_
#define REVISIT_CLIENT_CLI_COMMANDS_FRAME_COLUMNS_H_

#include <string>
#include <utility>
#include <vector>

#include "client/answers/deviation_text.h"
#include "client/answers/names.h"
#include "client/cli/commands/shared_flags.h"
#include "client/terminal/table.h"

namespace revisit::client {

inline constexpr char kFrameStatesHelp[] =
    "  AFTER        it ended where the next one began, and so on\n"
    "  DATUM        both were placed in a frame that they share\n"
    "  PROVISIONAL  by loop closures, but by fewer than three that agree\n"
    "  KNOWN        by three loop closures or more that agree\n"
    "  NONE         by nothing: only shapes are compared\n";

inline void AddFrameColumns(bool wide, std::vector<Table::Column>* columns) {
  columns->push_back({"FRAME", Table::Align::kLeft});
  for (const char* title : {"FRAME X m", "FRAME Y m", "FRAME YAW rad"}) {
    columns->push_back({title, Table::Align::kRight});
  }
  if (!wide) return;
  for (const char* title :
       {"SD X m", "SD Y m", "SD Z m", "SD YAW rad", "AT X m", "AT Y m"}) {
    columns->push_back({title, Table::Align::kRight});
  }
}

// Adds the cells below these columns. `message`: a revisit.v1.Recording or
// FrameTransform.
template <typename Message>
void AddFrameCells(const Message& message, bool wide,
                   std::vector<std::string>* cells) {
  cells->push_back(NameOf(message.frame_state()));
  const auto& pose = message.frame_pose();
  for (const auto& [value, digits] :
       {std::pair(pose.x_meters(), 2), std::pair(pose.y_meters(), 2),
        std::pair(pose.heading_radians(), 4)}) {
    cells->push_back(message.has_frame_pose() ? Fixed(value, digits) : "-");
  }
  if (!wide) return;
  for (std::string& deviation : DeviationTexts(message.frame_covariance())) {
    cells->push_back(std::move(deviation));
  }
  const auto& at = message.frame_reference();
  for (const double value : {at.x_meters(), at.y_meters()}) {
    cells->push_back(message.has_frame_reference() ? Fixed(value, 2) : "-");
  }
}

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_FRAME_COLUMNS_H_
