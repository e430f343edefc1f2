#include "server/records/stored_batch.h"

#include "absl/strings/str_cat.h"
#include "google/protobuf/io/coded_stream.h"
#include "server/base/status.h"
#include "server/fields/field_violations.h"

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

absl::Status DoesNotDecode(const absl::Status& cause) {
  return Corrupt(
      absl::StrCat("a stored batch does not decode: ", cause.message()));
}

absl::StatusOr<stored::PoseBatch> ParseBatch(const std::string& payload) {
  stored::PoseBatch batch;
  if (!batch.ParseFromString(payload)) return NotABatch();
  return batch;
}

absl::StatusOr<PoseColumns> ColumnsOf(const stored::PoseColumns& message) {
  if (message.pose_count() < 1) return NotABatch();
  Violations violations;
  PoseColumns columns(ColumnFieldsOf(message), FieldPath(), &violations);
  if (violations.count() > 0) return DoesNotDecode(violations.ToStatus());
  return columns;
}

absl::Status VisitFields(const stored::PoseBatch& batch,
                         const std::function<bool(const PoseFields&)>& visit) {
  bool goes_on = true;
  return VisitParts(
      batch,
      [&](int first, int end) {
        for (int i = first; i < end && goes_on; ++i) {
          goes_on = visit(PoseFieldsOf(batch.poses(i)));
        }
        return absl::OkStatus();
      },
      [&](PoseColumns* columns) {
        for (std::size_t i = 0; i < columns->size() && goes_on; ++i) {
          goes_on = visit(columns->At(i));
        }
        return absl::OkStatus();
      });
}

}  // namespace revisit::server
