// Lists that the server answers page by page.
#ifndef REVISIT_CLIENT_ANSWERS_PAGES_H_
#define REVISIT_CLIENT_ANSWERS_PAGES_H_

#include <cstdint>
#include <optional>
#include <string>
#include <type_traits>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "client/revisit/printable_text.h"
#include "revisit/v1/geometry.pb.h"

namespace revisit::client {

// Empty pages that may follow each other. The service sends none before the
// last page.
inline constexpr int kMostEmptyPages = 100;

// By what a list is ordered.
template <typename Item>
std::string OrderOf(const Item& item) {
  return item.name();
}
inline std::uint64_t OrderOf(const v1::Pose& pose) { return pose.sequence(); }

// Calls `visit(page)` for the pages of a list until it answers false or the
// last page was visited. `list(request)` asks for a page, and `items(page)` are
// what it holds. INTERNAL if the list does not go on in its order, as when the
// server sends a page again, or consists of empty pages: it might never end.
template <typename Request, typename List, typename Items, typename Visit>
absl::Status VisitPages(Request request, const List& list, const Items& items,
                        const Visit& visit) {
  using Order = std::decay_t<decltype(OrderOf(*items(*list(request)).begin()))>;
  std::optional<Order> last;
  int empty_pages = 0;
  for (;;) {
    const auto page = list(request);
    if (!page.ok()) return page.status();
    for (const auto& item : items(*page)) {
      Order order = OrderOf(item);
      if (last.has_value() && order <= *last) {
        return absl::InternalError(
            absl::StrCat("the server's list does not go on: ",
                         Printable(absl::StrCat(order)), " comes after ",
                         Printable(absl::StrCat(*last))));
      }
      last = std::move(order);
    }
    const absl::StatusOr<bool> goes_on = visit(*page);
    if (!goes_on.ok()) return goes_on.status();
    if (!*goes_on || page->next_page_token().empty()) return absl::OkStatus();
    empty_pages = items(*page).empty() ? empty_pages + 1 : 0;
    if (empty_pages > kMostEmptyPages) {
      return absl::InternalError(absl::StrCat(
          "the server's list does not go on: ", empty_pages,
          " empty pages follow each other, and each names another"));
    }
    request.set_page_token(page->next_page_token());
  }
}

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_ANSWERS_PAGES_H_
