#include "tests/server/plain_check_codec.h"

#include <cstdlib>
#include <sstream>

#include "server/base/status.h"

namespace revisit::server {
namespace {

constexpr const char* kStates[] = {"open", "confirmed", "rejected",
                                   "withdrawn"};

}  // namespace

std::string PlainCheckCodec::EncodeFound(const VehicleView&,
                                         const core::CandidateSet& set,
                                         std::chrono::nanoseconds,
                                         const CheckScope* scope) const {
  std::ostringstream line;
  line << "at " << set.query.value_or(-1) << std::hexfloat;
  for (const core::Candidate& candidate : set.candidates) {
    line << " " << candidate.rank << ":" << candidate.matched << ":"
         << (candidate.relative ? candidate.relative->probability : -1.0);
    if (candidate.drive) line << ":" << scope->vehicles[*candidate.drive].id;
  }
  return line.str();
}

std::string PlainCheckCodec::EncodeCheck(const StoredCheck& check) const {
  std::ostringstream text;
  text << check.found << "\n"
       << check.latest << "\n"
       << check.basis << " " << check.stale << "\n"
       << std::hexfloat;
  for (const StoredCandidate& candidate : check.candidates) {
    text << candidate.number << " " << candidate.rank << " "
         << candidate.matched_sequence << " "
         << static_cast<int>(candidate.state) << " "
         << static_cast<int>(candidate.cause) << " " << candidate.update_time_ns
         << " " << candidate.latest_rank << " " << candidate.probability << " "
         << candidate.value << " '" << candidate.actor << "' '"
         << candidate.decision << "' '" << candidate.contradicted << "' '"
         << candidate.matched_vehicle << "' '" << candidate.matched_uid << "' "
         << candidate.place_first << " " << candidate.place_last << " '"
         << candidate.group << "'\n";
  }
  return text.str();
}

absl::StatusOr<StoredCheck> PlainCheckCodec::DecodeCheck(
    const std::string& payload) const {
  std::istringstream text(payload);
  StoredCheck check;
  std::getline(text, check.found);
  std::getline(text, check.latest);
  text >> check.basis >> check.stale;
  text.ignore();
  const auto unquoted = [](const std::string& word) {
    return word.size() < 2 ? word : word.substr(1, word.size() - 2);
  };
  while (text.peek() != std::istringstream::traits_type::eof()) {
    StoredCandidate& candidate = check.candidates.emplace_back();
    int state = 0;
    int cause = 0;
    // Streams write what they do not read.
    std::string probability;
    std::string value;
    if (!(text >> candidate.number >> candidate.rank >>
          candidate.matched_sequence >> state >> cause >>
          candidate.update_time_ns >> candidate.latest_rank >> probability >>
          value >> candidate.actor >> candidate.decision >>
          candidate.contradicted >> candidate.matched_vehicle >>
          candidate.matched_uid >> candidate.place_first >>
          candidate.place_last >> candidate.group)) {
      return Corrupt("no check");
    }
    text.ignore();
    candidate.state = static_cast<CandidateState>(state);
    candidate.cause = static_cast<CandidateCause>(cause);
    candidate.actor = unquoted(candidate.actor);
    candidate.decision = unquoted(candidate.decision);
    candidate.contradicted = unquoted(candidate.contradicted);
    candidate.matched_vehicle = unquoted(candidate.matched_vehicle);
    candidate.matched_uid = unquoted(candidate.matched_uid);
    candidate.group = unquoted(candidate.group);
    candidate.probability = std::strtod(probability.c_str(), nullptr);
    candidate.value = std::strtod(value.c_str(), nullptr);
  }
  return check;
}

std::string PlainCheckCodec::EncodeEvent(const EventOrigin& origin,
                                         std::uint64_t check_sequence,
                                         const StoredCheck& check,
                                         std::size_t index) const {
  const StoredCandidate& candidate = check.candidates[index];
  std::ostringstream line;
  line << origin.vehicle_id << " " << check_sequence << "/" << candidate.number
       << " " << kStates[static_cast<int>(candidate.state)];
  if (!candidate.decision.empty()) line << " by " << candidate.decision;
  if (!candidate.actor.empty()) line << ", said " << candidate.actor;
  line << ": " << (candidate.latest_rank > 0 ? check.latest : check.found);
  return line.str();
}

std::string PlainCheckCodec::EncodeFarewell(const EventOrigin& origin) const {
  return origin.vehicle_id + " is deleted";
}

}  // namespace revisit::server
