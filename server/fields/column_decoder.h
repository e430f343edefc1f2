// Poses of columns as samples of core.
#ifndef REVISIT_SERVER_FIELDS_COLUMN_DECODER_H_
#define REVISIT_SERVER_FIELDS_COLUMN_DECODER_H_

#include <vector>

#include "core/geometry/pose.h"
#include "server/fields/field_violations.h"
#include "server/fields/pose_columns.h"
#include "server/fields/pose_decoder.h"

namespace revisit::server {

// The samples that the decoder makes of the poses, to the bit, with the
// violations that it adds below a field `poses`. Local poses without a defect
// are checked a column at a time, which takes a fraction of the time.
// REQUIRES: there were no violations of the columns, of which there is a pose;
// `violations` are the decoder's.
std::vector<core::PoseSample> DecodeColumns(PoseColumns* columns,
                                            PoseDecoder* decoder,
                                            Violations* violations);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_COLUMN_DECODER_H_
