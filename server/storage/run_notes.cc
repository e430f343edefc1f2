#include "server/storage/run_notes.h"

#include <chrono>
#include <utility>

#include "server/base/metrics.h"

namespace revisit::server {
namespace {

// Values of the label `reason`, by the word of the note.
constexpr std::pair<const char*, const char*> kExitReasons[] = {
    {kStopped, "stopped"},
    {kStoreFailed, "store_failed"},
    {kRunning, "killed"}};

}  // namespace

RunNotes::RunNotes(std::string store_file, const Log* log)
    : store_file_(std::move(store_file)), log_(log) {
  if (!store_file_.empty()) last_exit_ = ReadNote(ExitNoteOf(store_file_));
}

void RunNotes::Note(const char* word) const {
  if (store_file_.empty()) return;
  const std::string file = ExitNoteOf(store_file_);
  if (!WriteNote(file, {word, std::chrono::system_clock::now()})) {
    log_->Write(LogLevel::kWarning, "exit_note_not_written", {{"file", file}});
  }
}

void RunNotes::CollectMetrics(Metrics* metrics) const {
  if (store_file_.empty()) return;
  if (const auto backup = ReadNote(BackupNoteOf(store_file_))) {
    metrics
        ->Gauge("revisit_store_backup_timestamp_seconds",
                "When the last backup was made, since the Unix epoch.")
        .Add(backup->time);
  }
  CollectLastExit(metrics);
}

void RunNotes::CollectLastExit(Metrics* metrics) const {
  MetricFamily& reasons = metrics->Gauge(
      "revisit_last_exit",
      "How the server of this store before this one ended, by reason.");
  for (const auto& [word, reason] : kExitReasons) {
    reasons.Add(last_exit_ && last_exit_->word == word, {{"reason", reason}});
  }
  // Nobody knows when a server was killed.
  if (!last_exit_ || last_exit_->word == kRunning) return;
  metrics
      ->Gauge("revisit_last_exit_timestamp_seconds",
              "When that server ended, since the Unix epoch.")
      .Add(last_exit_->time);
}

}  // namespace revisit::server
