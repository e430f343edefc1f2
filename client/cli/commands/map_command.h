// revisit map
#ifndef REVISIT_CLIENT_CLI_COMMANDS_MAP_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_MAP_COMMAND_H_

#include <string>

#include "absl/status/status.h"
#include "client/cli/console.h"
#include "client/cli/flags.h"
#include "client/cli/map/server_map.h"
#include "client/revisit/client.h"

namespace revisit::client {

void AddMapCommand(const Command& program);

enum class MapFormat { kHtml, kSvg, kGeoJson };

struct MapOptions {
  std::string vehicle;
  MapFormat format = MapFormat::kHtml;
  CheckSearches searches;
  // The map goes to the console if this is empty.
  std::string output;
};

// An existing file is replaced when the map is complete, and only then.
absl::Status RunMap(const Client& client, const MapOptions& options,
                    const Console& console);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_MAP_COMMAND_H_
