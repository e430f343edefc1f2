// revisit map
#ifndef REVISIT_CLIENT_CLI_COMMANDS_MAP_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_MAP_COMMAND_H_

#include <string>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/map/server_map.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void AddMapCommand(const Command& program);

enum class MapFormat { kHtml, kSvg, kGeoJson };

struct MapOptions {
  std::string vehicle;
  MapFormat format = MapFormat::kHtml;
  CheckSearches searches;
  // The map goes to the terminal if this is empty.
  std::string output;
};

// An existing file is replaced when the map is complete, and only then.
absl::Status RunMap(const Client& client, const MapOptions& options,
                    const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_MAP_COMMAND_H_
