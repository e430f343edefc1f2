// Parts that the calls about members, links and rejected candidates share.
#ifndef REVISIT_SERVER_SERVICE_GROUP_PAGE_H_
#define REVISIT_SERVER_SERVICE_GROUP_PAGE_H_

#include <cstddef>
#include <functional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/conversion/names.h"
#include "server/conversion/page_token.h"
#include "server/service/readable_page.h"
#include "server/service/unary_call.h"

namespace revisit::server {

// Names the group and, in it, what `parsed` is the name of.
inline absl::Status ChooseInGroup(const absl::StatusOr<NameInGroup>& parsed,
                                  UnaryCall* call) {
  if (!parsed.ok()) return parsed.status();
  return call->ChooseGroup(parsed->group_id);
}

// Fills a page with rows of a group, in the order of their ids. Damaged rows
// are left out; a page of its own, behind all others, says what is wrong with
// them.
//   `visit`: VisitMembers() or VisitLinks() with one of their visitors;
//   `id_of(row)`; `add(row)`: puts one on the page, and says how many bytes it
//   takes, or nothing where the caller may not read it.
template <typename Row, typename IdOf, typename Add, typename Response>
absl::Status FillGroupPage(
    const std::function<absl::Status(const std::function<bool(Row&)>&)>& visit,
    const IdOf& id_of, const Add& add, const AskedPage& asked,
    Response* response) {
  PageFill page{asked.size};
  std::string last;
  bool is_last = true;
  absl::Status damage;
  const absl::Status status = visit([&](Row& row) {
    const std::string id = id_of(row);
    if (row.damage.ok() && id <= asked.after) return true;
    if (row.damage.ok() && page.is_full()) {
      is_last = false;
      return false;
    }
    const absl::StatusOr<std::size_t> bytes = add(row);
    if (!bytes.ok()) {
      damage.Update(bytes.status());
    } else if (*bytes > 0) {
      page.Add(*bytes);
      last = id;
    }
    return true;
  });
  if (!status.ok()) return status;
  if (is_last && damage.ok()) return absl::OkStatus();
  // A page that is full has a last one.
  if (last.empty()) return damage;
  response->set_next_page_token(MakePageToken(asked.list, last));
  return absl::OkStatus();
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_GROUP_PAGE_H_
