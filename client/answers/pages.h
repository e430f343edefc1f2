// Lists that the server answers page by page.
#ifndef REVISIT_CLIENT_ANSWERS_PAGES_H_
#define REVISIT_CLIENT_ANSWERS_PAGES_H_

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <set>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "client/revisit/printable_text.h"
#include "revisit/v1/check.pb.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/group.pb.h"
#include "revisit/v1/loop_closure.pb.h"
#include "revisit/v1/recording.pb.h"

namespace revisit::client {

// Empty pages that may follow each other. The service sends none before the
// last page, but of what groups have, where the caller may not read it, and of
// checks, where a filter may leave out all that was read.
template <typename Item>
inline constexpr int kMostEmptyPages = 100;
template <>
inline constexpr int kMostEmptyPages<v1::Check> = 10'000;

// By what a list is ordered.
template <typename Item>
std::string OrderOf(const Item& item) {
  return item.name();
}
inline std::uint64_t OrderOf(const v1::Pose& pose) { return pose.sequence(); }
// The number that its name ends with, which becomes smaller; 0 if there is
// none.
inline std::int64_t OrderOf(const v1::DeletedPosePair& pair) {
  std::int64_t number = 0;
  const std::string& name = pair.name();
  return absl::SimpleAtoi(name.substr(name.rfind('/') + 1), &number) ? -number
                                                                     : 0;
}
inline std::uint64_t OrderOf(const v1::Recording& recording) {
  return recording.first_sequence();
}
// The order of `vehicles/{vehicle}/{collection}/{sequence}`: the name of the
// vehicle, then the sequence with as many digits as any has. The blank between
// them is before all that an id may have.
inline std::string OrderBySequence(const std::string& name,
                                   const std::string& collection) {
  constexpr std::size_t kDigits = 20;
  const std::size_t slash = name.rfind("/" + collection + "/");
  if (slash == name.npos) return name;
  std::string sequence = name.substr(name.rfind('/') + 1);
  sequence.insert(0, kDigits - std::min(kDigits, sequence.size()), '0');
  return name.substr(0, slash) + " " + sequence;
}
inline std::string OrderOf(const v1::Check& check) {
  return OrderBySequence(check.name(), "checks");
}
inline std::string OrderOf(const v1::FrameTransform& transform) {
  return OrderBySequence(transform.recording(), "recordings");
}

// How a list is ordered.
enum class PageOrder {
  // The order of OrderOf(), which never changes.
  kByName,
  // One that may change while the pages are read, so that an item comes twice.
  kChanging,
};

// The pages of a list, one after the other. `list(request)` asks for a page,
// and `items(page)` are what it holds.
template <typename Request, typename List, typename Items>
class PageReader {
 public:
  using Page = std::decay_t<decltype(*std::declval<List>()(
      std::declval<const Request&>()))>;

  PageReader(Request request, List list, Items items,
             PageOrder order = PageOrder::kByName)
      : request_(std::move(request)),
        list_(std::move(list)),
        items_(std::move(items)),
        order_(order) {}

  // Reads the next page; false after the last one. INTERNAL if the list does
  // not go on in its order, as when the server sends a page again, or consists
  // of pages that are empty or bring nothing new: it might never end.
  absl::StatusOr<bool> Next() {
    if (ended_) return false;
    auto page = list_(request_);
    if (!page.ok()) return page.status();
    page_ = *std::move(page);
    bool brought_something = false;
    for (const auto& item : items_(page_)) {
      if (order_ == PageOrder::kChanging) {
        brought_something |= seen_.insert(OrderOf(item)).second;
        continue;
      }
      brought_something = true;
      if (absl::Status status = Follow(OrderOf(item)); !status.ok()) {
        return status;
      }
    }
    ended_ = page_.next_page_token().empty();
    request_.set_page_token(page_.next_page_token());
    empty_pages_ = brought_something ? 0 : empty_pages_ + 1;
    if (empty_pages_ > kMostEmptyPages<Item>) {
      return absl::InternalError(absl::StrCat(
          "the server's list does not go on: ", empty_pages_,
          " pages that bring nothing new follow each other, and each names "
          "another"));
    }
    return true;
  }

  // The page that was read last.
  const Page& page() const { return page_; }

 private:
  using Item = std::decay_t<
      decltype(*std::declval<Items>()(std::declval<const Page&>()).begin())>;
  using Order = std::decay_t<decltype(OrderOf(std::declval<const Item&>()))>;

  absl::Status Follow(Order order) {
    if (last_.has_value() && order <= *last_) {
      return absl::InternalError(absl::StrCat(
          "the server's list does not go on: ", Printable(absl::StrCat(order)),
          " comes after ", Printable(absl::StrCat(*last_))));
    }
    last_ = std::move(order);
    return absl::OkStatus();
  }

  Request request_;
  const List list_;
  const Items items_;
  Page page_;
  const PageOrder order_;
  std::optional<Order> last_;
  // All that came, where the order may change.
  std::set<Order> seen_;
  int empty_pages_ = 0;
  bool ended_ = false;
};

// Calls `visit(page)` for the pages of a list until it answers false or the
// last page was visited. Errors are those of PageReader and of `visit`.
template <typename Request, typename List, typename Items, typename Visit>
absl::Status VisitPages(Request request, const List& list, const Items& items,
                        const Visit& visit,
                        PageOrder order = PageOrder::kByName) {
  PageReader<Request, List, Items> reader(std::move(request), list, items,
                                          order);
  for (;;) {
    const absl::StatusOr<bool> found = reader.Next();
    if (!found.ok()) return found.status();
    if (!*found) return absl::OkStatus();
    const absl::StatusOr<bool> goes_on = visit(reader.page());
    if (!goes_on.ok()) return goes_on.status();
    if (!*goes_on) return absl::OkStatus();
  }
}

// All that the pages of a list hold. Errors are those of PageReader.
template <typename Request, typename List, typename Items>
auto ReadPages(Request request, const List& list, const Items& items)
    -> absl::StatusOr<
        std::vector<std::decay_t<decltype(*items((*list(request))).begin())>>> {
  PageReader<Request, List, Items> reader(std::move(request), list, items);
  std::vector<std::decay_t<decltype(*items(reader.page()).begin())>> all;
  for (;;) {
    const absl::StatusOr<bool> found = reader.Next();
    if (!found.ok()) return found.status();
    if (!*found) return all;
    all.insert(all.end(), items(reader.page()).begin(),
               items(reader.page()).end());
  }
}

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_ANSWERS_PAGES_H_
