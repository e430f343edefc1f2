// Pose graphs in the text format of g2o.
//
// The covariance of a vertex is composed from the first one, which is exactly
// known, along the edges between vertices whose ids follow each other in the
// file's order of ids. The information of an edge weighs the error that g2o
// defines: in the axes of the edge's second vertex, and for SE3 in the vector
// part of the error's quaternion, half of a rotation vector.
#ifndef REVISIT_CLIENT_FORMATS_G2O_READER_H_
#define REVISIT_CLIENT_FORMATS_G2O_READER_H_

#include <memory>

#include "absl/status/statusor.h"
#include "client/formats/reader.h"
#include "client/formats/text_lines.h"

namespace revisit::client {

absl::StatusOr<std::unique_ptr<SampleReader>> ReadG2o(
    std::unique_ptr<Lines> lines, const ReaderOptions& options);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_G2O_READER_H_
