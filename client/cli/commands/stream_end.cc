#include "client/cli/commands/stream_end.h"

#include <chrono>

#include "absl/strings/str_cat.h"
#include "client/revisit/printable_text.h"

namespace revisit::client {
namespace {

void Interrupt(PoseStream* stream, const std::string& vehicle, bool appended,
               const Terminal& terminal) {
  constexpr std::chrono::seconds kPatience{2};
  // Why it ended does not matter any more.
  (void)stream->FinishWithin(kPatience);
  const absl::Status status =
      WithDurable(LocalError(absl::CancelledError("interrupted")), vehicle,
                  *stream, appended);
  terminal.out.flush();
  // A bar may stand in the line.
  if (terminal.progress_is_terminal) terminal.progress << '\n';
  terminal.progress << (terminal.json() ? ErrorToJson(status)
                                        : "revisit: " + ErrorText(status))
                    << '\n'
                    << std::flush;
}

}  // namespace

absl::Status WithDurable(const absl::Status& status, const std::string& vehicle,
                         const PoseStream& stream, bool appended) {
  if (status.ok()) return status;
  const std::uint64_t durable = stream.acked_sequence();
  const std::string uid = Printable(stream.vehicle_uid());
  const std::string name = Printable(vehicle);
  const char* const again =
      appended ? "all its recordings in order, without --append, go on behind "
                 "them"
               : "the same command again goes on behind them";
  return WithHint(
      status,
      durable == 0
          ? absl::StrCat("no pose of ", name,
                         " is known to be durable; the same command again "
                         "begins with the first")
          : absl::StrCat("poses 1 to ", durable, " of ", name, " are durable; ",
                         again, " (with --acked-sequence ", durable,
                         " --vehicle-uid ", uid,
                         " it fails if they are lost)"));
}

StreamInterrupt::StreamInterrupt(PoseStream* stream, const std::string& vehicle,
                                 bool appended, const Terminal& terminal)
    : guard_([stream, vehicle, appended, &terminal] {
        Interrupt(stream, vehicle, appended, terminal);
      }) {}

}  // namespace revisit::client
