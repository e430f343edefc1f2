// Stored checks as plain text, so that tests of sessions need no messages.
#ifndef REVISIT_TESTS_SERVER_PLAIN_CHECK_CODEC_H_
#define REVISIT_TESTS_SERVER_PLAIN_CHECK_CODEC_H_

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <string>

#include "absl/status/statusor.h"
#include "server/sessions/check_codec.h"

namespace revisit::server {

// What was found is one line: the query's node, and each candidate's rank,
// matched node and probability, exactly, and the id of another vehicle in which
// the node is. A check is that line, and a line for
// each candidate that is kept. An event is a line: "truck 25/1 confirmed by a,
// said bob: " and what was found; or "truck is deleted".
class PlainCheckCodec final : public CheckCodec {
 public:
  std::string EncodeFound(const VehicleView& view,
                          const core::CandidateSet& set,
                          std::chrono::nanoseconds duration,
                          const CheckScope* scope) const override;
  std::string EncodeCheck(const StoredCheck& check) const override;
  absl::StatusOr<StoredCheck> DecodeCheck(
      const std::string& payload) const override;
  std::string EncodeEvent(const EventOrigin& origin,
                          std::uint64_t check_sequence,
                          const StoredCheck& check,
                          std::size_t index) const override;
  std::string EncodeFarewell(const EventOrigin& origin) const override;
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_PLAIN_CHECK_CODEC_H_
