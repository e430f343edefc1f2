#include "client/cli/commands/info_command.h"

#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"

namespace revisit::client {

void AddInfoCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"info", "Shows the version and the limits of the server.",
       "Callers that belong to a tenant are not told what is in memory, nor "
       "which servers share the store.",
       "  revisit info\n"
       "  revisit info --server revisit.example:50051 --tls-ca ca.pem "
       "--json"});
  command.Runs([](const Connection& server, const Terminal& terminal) {
    return RunInfo(server.client, server.options.address, terminal);
  });
}

absl::Status RunInfo(const Client& client, const std::string& address,
                     const Terminal& terminal) {
  const auto info = client.GetServerInfo();
  if (!info.ok()) return info.status();
  if (terminal.json()) {
    terminal.out << ToJson(*info, true) << '\n';
    return absl::OkStatus();
  }
  std::string durability = NameOf(info->durability());
  if (!info->durability_settings().empty()) {
    absl::StrAppend(&durability, " (", info->durability_settings(), ")");
  }
  std::vector<std::pair<std::string, std::string>> fields = {
      {"server", address},
      {"version", info->version()},
      {"durability", durability},
      {"store format", absl::StrCat(info->store_format())},
      {"poses in a batch", absl::StrCat("at most ", info->max_batch_poses())},
      {"message", absl::StrCat("at most ", info->max_message_bytes(), " B")},
      {"batches in flight",
       absl::StrCat("at most ", info->max_batches_in_flight(), " per stream")}};
  if (info->over_all_tenants()) {
    fields.insert(
        fields.end(),
        {{"vehicles in memory", absl::StrCat(info->resident_vehicle_count())},
         {"nodes in memory", absl::StrCat(info->resident_node_count())},
         {"graphs in memory", absl::StrCat(info->resident_bytes(), " B")}});
  } else {
    // The message has 0 for these callers, as if nothing were in memory.
    fields.emplace_back("in memory", "not told to a tenant's caller");
  }
  for (const v1::StoreServer& server : info->servers()) {
    fields.emplace_back("shares the store",
                        absl::StrCat(server.address(), ", vehicles owned: ",
                                     server.owned_vehicle_count()));
  }
  PrintFields(fields, terminal.out);
  return absl::OkStatus();
}

}  // namespace revisit::client
