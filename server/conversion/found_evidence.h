// The evidence of one candidate within the bytes of a CandidateSet.
#ifndef REVISIT_SERVER_CONVERSION_FOUND_EVIDENCE_H_
#define REVISIT_SERVER_CONVERSION_FOUND_EVIDENCE_H_

#include <cstdint>
#include <string>

namespace revisit::server {

struct FoundEvidence {
  // CandidateSet.revision.
  std::uint64_t revision = 0;
  // The Candidate as bytes; empty if none has the rank.
  std::string evidence;
};

// Each candidate of a check is told with its evidence alone, so this makes no
// message of the others. All is empty if the bytes are not those of a set.
FoundEvidence FindEvidence(const std::string& set, int rank);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_FOUND_EVIDENCE_H_
