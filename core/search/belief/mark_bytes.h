// The evidence of marks as bytes, so that whoever has the same drive later need
// not search them again.
#ifndef REVISIT_CORE_SEARCH_BELIEF_MARK_BYTES_H_
#define REVISIT_CORE_SEARCH_BELIEF_MARK_BYTES_H_

#include <string>

#include "absl/strings/string_view.h"
#include "core/search/belief/drive_belief.h"
#include "core/search/belief/mark.h"
#include "core/settings.h"

namespace revisit::core {

// All marks that are known, with what shows later of which poses and under
// which settings they were found. REQUIRES: they are marks of the line, under
// these settings.
std::string SaveMarks(const MarkMemory& marks, const MarkLine& line,
                      const DriveSettings& settings);
// Puts marks that were saved in the place of those that are known. False, and
// nothing changes, if the bytes are damaged so that a later call could fail, or
// are of another version, of settings under which marks show something else, or
// of nodes that the line's graph does not have. Damage that leaves numbers in
// their ranges is not found: guard the bytes with a checksum.
bool LoadMarks(absl::string_view bytes, const MarkLine& line,
               const DriveSettings& settings, MarkMemory* marks);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_BELIEF_MARK_BYTES_H_
