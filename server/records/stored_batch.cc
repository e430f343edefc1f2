#include "server/records/stored_batch.h"

#include "google/protobuf/io/coded_stream.h"
#include "server/base/status.h"

namespace revisit::server {

using google::protobuf::io::CodedOutputStream;

std::size_t BytesInBatch(std::size_t size) {
  return 1 + size +
         static_cast<std::size_t>(
             CodedOutputStream::VarintSize32(static_cast<std::uint32_t>(size)));
}

std::uint8_t* BeginPose(std::size_t size, std::uint8_t* next) {
  next = CodedOutputStream::WriteTagToArray(kPosesTag, next);
  return CodedOutputStream::WriteVarint32ToArray(
      static_cast<std::uint32_t>(size), next);
}

absl::Status NotABatch() {
  return Corrupt("a stored batch is not a PoseBatch");
}

absl::StatusOr<stored::PoseBatch> ParseBatch(const std::string& payload) {
  stored::PoseBatch batch;
  if (!batch.ParseFromString(payload)) return NotABatch();
  return batch;
}

}  // namespace revisit::server
