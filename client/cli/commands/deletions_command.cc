#include "client/cli/commands/deletions_command.h"

#include <memory>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_replace.h"
#include "client/answers/names.h"
#include "client/answers/pages.h"
#include "client/revisit/printable_text.h"
#include "google/protobuf/util/time_util.h"

namespace revisit::client {
namespace {

using google::protobuf::util::TimeUtil;
using Deletions = v1::ListDeletedPosePairsResponse;
using DeletionsRequest = v1::ListDeletedPosePairsRequest;

absl::StatusOr<std::vector<v1::DeletedPosePair>> ListAllDeletions(
    const Client& client, const std::string& vehicle) {
  DeletionsRequest request;
  request.set_parent(VehicleName(vehicle));
  request.set_page_size(500);
  return ReadPages(
      request,
      [&](const DeletionsRequest& asked) {
        return client.ListDeletedPosePairs(asked);
      },
      [](const Deletions& page) -> const auto& {
        return page.deleted_pose_pairs();
      });
}

std::string OrDash(const std::string& text) {
  return text.empty() ? "-" : text;
}

// The cells behind those of the deletion. Loop closures and rejections have
// these fields in common.
template <typename Pair>
std::vector<std::string> CellsOf(const char* decision, const Pair& pair) {
  return {decision,
          absl::StrCat(pair.query_sequence()),
          absl::StrCat(pair.matched_sequence()),
          TimeUtil::ToString(pair.create_time()),
          OrDash(pair.decided_by()),
          absl::StrReplaceAll(pair.note(), {{"\n", " "}, {"\t", " "}})};
}

void PrintDeletions(const std::vector<v1::DeletedPosePair>& all,
                    const Terminal& terminal) {
  using Align = Table::Align;
  // The note is last, since it is as long as whoever wrote it wanted.
  Table table({{"DELETED", Align::kLeft},
               {"DELETED_BY", Align::kLeft},
               {"DECISION", Align::kLeft},
               {"QUERY_SEQ", Align::kRight},
               {"MATCHED_SEQ", Align::kRight},
               {"CREATED", Align::kLeft},
               {"DECIDED_BY", Align::kLeft},
               {"NOTE", Align::kLeft}});
  for (const v1::DeletedPosePair& deleted : all) {
    std::vector<std::string> row = {TimeUtil::ToString(deleted.delete_time()),
                                    OrDash(deleted.deleted_by())};
    for (std::string& cell :
         deleted.has_loop_closure()
             ? CellsOf("confirmed", deleted.loop_closure())
             : CellsOf("rejected", deleted.rejected_candidate())) {
      row.push_back(std::move(cell));
    }
    table.AddRow(std::move(row));
  }
  table.Print(terminal.out, terminal.width);
}

}  // namespace

void AddDeletionsCommand(const Command& program) {
  const Command group = program.AddCommand(
      {"deletions", "Lists the decisions that were undone.", "", ""});
  const Command list = group.AddCommand(
      {"list",
       "Lists a vehicle's last 1000 loop closures and rejections that were "
       "deleted.",
       "", "  revisit deletions list shuttle-7"});
  const auto vehicle = std::make_shared<std::string>();
  list.AddText("VEHICLE", "TEXT", vehicle.get(), "Id, or name").Required();
  list.AlsoPrints({OutputFormat::kName});
  list.Runs([vehicle](const Connection& server, const Terminal& terminal) {
    return RunDeletionsList(server.client, *vehicle, terminal);
  });
}

absl::Status RunDeletionsList(const Client& client, const std::string& vehicle,
                              const Terminal& terminal) {
  const auto all = ListAllDeletions(client, vehicle);
  if (!all.ok()) return all.status();
  if (terminal.json()) {
    Deletions response;
    response.mutable_deleted_pose_pairs()->Assign(all->begin(), all->end());
    terminal.out << ToJson(response, true) << '\n';
  } else if (terminal.names()) {
    for (const v1::DeletedPosePair& deleted : *all) {
      terminal.out << Printable(deleted.name()) << '\n';
    }
  } else {
    PrintDeletions(*all, terminal);
  }
  return absl::OkStatus();
}

}  // namespace revisit::client
