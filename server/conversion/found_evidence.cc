#include "server/conversion/found_evidence.h"

#include "google/protobuf/io/coded_stream.h"
#include "google/protobuf/wire_format_lite.h"
#include "revisit/v1/candidate.pb.h"

namespace revisit::server {
namespace {

using google::protobuf::internal::WireFormatLite;
using google::protobuf::io::CodedInputStream;

constexpr std::uint32_t kRevision = WireFormatLite::MakeTag(
    v1::CandidateSet::kRevisionFieldNumber, WireFormatLite::WIRETYPE_VARINT);
constexpr std::uint32_t kCandidate =
    WireFormatLite::MakeTag(v1::CandidateSet::kCandidatesFieldNumber,
                            WireFormatLite::WIRETYPE_LENGTH_DELIMITED);
constexpr std::uint32_t kRank = WireFormatLite::MakeTag(
    v1::Candidate::kRankFieldNumber, WireFormatLite::WIRETYPE_VARINT);

// Moves behind the candidate that comes, and tells its bytes if it has the
// rank.
bool ReadCandidate(int rank, const std::string& set, CodedInputStream* stream,
                   std::string* evidence) {
  std::uint32_t size = 0;
  if (!stream->ReadVarint32(&size)) return false;
  const int begin = stream->CurrentPosition();
  if (size > set.size() - static_cast<std::size_t>(begin)) return false;
  const int end = begin + static_cast<int>(size);
  const CodedInputStream::Limit limit =
      stream->PushLimit(static_cast<int>(size));
  std::uint64_t its_rank = 0;
  while (const std::uint32_t tag = stream->ReadTag()) {
    if (tag == kRank) {
      if (!stream->ReadVarint64(&its_rank)) return false;
      break;
    }
    if (!WireFormatLite::SkipField(stream, tag)) return false;
  }
  stream->PopLimit(limit);
  if (static_cast<int>(its_rank) == rank) {
    evidence->assign(set, static_cast<std::size_t>(begin), size);
  }
  return stream->Skip(end - stream->CurrentPosition());
}

}  // namespace

FoundEvidence FindEvidence(const std::string& set, int rank) {
  FoundEvidence found;
  CodedInputStream stream(reinterpret_cast<const std::uint8_t*>(set.data()),
                          static_cast<int>(set.size()));
  while (const std::uint32_t tag = stream.ReadTag()) {
    const bool is_read =
        tag == kRevision    ? stream.ReadVarint64(&found.revision)
        : tag == kCandidate ? ReadCandidate(rank, set, &stream, &found.evidence)
                            : WireFormatLite::SkipField(&stream, tag);
    if (!is_read) return {};
  }
  return stream.ConsumedEntireMessage() ? found : FoundEvidence();
}

}  // namespace revisit::server
