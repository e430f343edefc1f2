// Notes that servers of a store in a file leave beside it for the next one, and
// what operators see of that.
#ifndef REVISIT_SERVER_STORAGE_RUN_NOTES_H_
#define REVISIT_SERVER_STORAGE_RUN_NOTES_H_

#include <optional>
#include <string>

#include "server/base/logging.h"
#include "server/storage/store_note.h"

namespace revisit::server {

class Metrics;

// Thread-safe.
class RunNotes {
 public:
  // Reads how the server of the store before this one ended. `store_file` is
  // empty for a store in a database, which has no place for notes: then this
  // does nothing. The log outlives this.
  RunNotes(std::string store_file, const Log* log);

  // Has the next server of this store know how this one ended, or, until then,
  // that it runs: a word of store_note.h.
  void Note(const char* word) const;

  // How the server before ended, and when the last backup was made.
  void CollectMetrics(Metrics* metrics) const;

 private:
  void CollectLastExit(Metrics* metrics) const;

  const std::string store_file_;
  const Log* const log_;
  std::optional<StoreNote> last_exit_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_RUN_NOTES_H_
