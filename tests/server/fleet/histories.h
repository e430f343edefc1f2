// What tests of histories compare: every number of a view, as text.
#ifndef REVISIT_TESTS_SERVER_FLEET_HISTORIES_H_
#define REVISIT_TESTS_SERVER_FLEET_HISTORIES_H_

#include <sstream>
#include <string>

#include "core/drive/drive_view.h"
#include "server/fleet/known_history.h"

namespace revisit::server {

inline std::string ToText(const core::DriveView& view) {
  std::ostringstream text;
  text << std::hexfloat << static_cast<int>(view.state_space) << " "
       << view.node_spacing_meters << " " << view.scale << "\n";
  for (core::NodeIndex i = 0; i < view.graph.size(); ++i) {
    const core::Node node = view.graph.node(i);
    text << node.sequence << " " << node.fraction << " "
         << node.travelled_meters << " " << node.pose.x << " " << node.pose.y
         << " " << node.pose.heading << " " << view.graph.SegmentStart(i);
    for (const double value : node.covariance.upper) text << " " << value;
    text << "\n";
  }
  for (std::size_t k = 0; k < view.recordings.size(); ++k) {
    text << "recording " << view.recordings[k].first_sequence << "\n";
  }
  for (const core::ConfirmedLoop& loop : view.loops) {
    text << loop.query << " - " << loop.matched;
    if (loop.measured != nullptr) {
      text << " " << loop.measured->measurement.relative.x << " "
           << loop.measured->query.pose.x << " "
           << loop.measured->matched.pose.x;
    }
    text << "\n";
  }
  return text.str();
}

inline std::string ToText(const KnownHistory& history) {
  std::ostringstream text;
  text << history.vehicle_id << " " << history.config.uid << " "
       << history.revision << " " << history.last_sequence << "\n"
       << ToText(*history.view);
  return text.str();
}

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_FLEET_HISTORIES_H_
