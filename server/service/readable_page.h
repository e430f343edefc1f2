// A page of a list that several tenants share: what its caller may read of it.
#ifndef REVISIT_SERVER_SERVICE_READABLE_PAGE_H_
#define REVISIT_SERVER_SERVICE_READABLE_PAGE_H_

#include <algorithm>
#include <cstddef>
#include <string>

#include "absl/status/statusor.h"
#include "server/security/caller.h"

namespace revisit::server {

// A page ends where it is longer than this, so that clients with the usual
// limit of 4 MiB can read it.
inline constexpr std::size_t kMostPageBytes = std::size_t{1} << 20;

// How much is on a page.
struct PageFill {
  int most = 0;
  int count = 0;
  std::size_t bytes = 0;

  bool is_full() const { return count == most || bytes > kMostPageBytes; }
  void Add(std::size_t more) {
    ++count;
    bytes += more;
  }
};

// Adds to a page what comes after the id `after` and what the caller may read.
// The rest leaves no trace, neither in the page's length nor in its token. The
// id of the last one on it; empty if it is the last page. Blocks on the
// storage.
//   `list(after, prefix, limit)`: reads some records, as Storage::ListVehicles;
//   `add(record)`: puts one on the page, and says how many bytes it takes.
template <typename List, typename Add>
absl::StatusOr<std::string> FillReadablePage(const Caller& caller,
                                             Resource resource,
                                             const std::string& after,
                                             int page_size, const List& list,
                                             const Add& add) {
  PageFill page{page_size};
  std::string last;
  for (const std::string& prefix : caller.PrefixesOf(Verb::kRead, resource)) {
    std::string place = after;
    for (bool past = false; !past;) {
      // One more shows whether there is another page. Reading few at a time
      // would be slow where the caller may read few of many.
      const int wanted = std::max(page_size - page.count + 1, 100);
      const auto records = list(place, prefix, wanted);
      if (!records.ok()) return records.status();
      past = static_cast<int>(records->size()) < wanted;
      for (const auto& record : *records) {
        if (!caller.May(Verb::kRead, record.id, resource)) continue;
        if (page.is_full()) return last;
        page.Add(add(record));
        last = record.id;
      }
      if (!past) place = records->back().id;
    }
  }
  return std::string();
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_READABLE_PAGE_H_
