// Which build this is.
#ifndef REVISIT_CORE_BASE_BUILD_INFO_H_
#define REVISIT_CORE_BASE_BUILD_INFO_H_

namespace revisit {

// The version is that of the CMake project, such as "1.2.3".
extern const char kVersion[];

// Version, commit and date, such as "1.2.3 (commit 82b9556ac0, built
// 2026-11-22)". Without the commit where it is not known, as in a tree without
// its history.
extern const char kVersionText[];

// YYYY-MM-DD, in UTC.
extern const char kBuildDate[];

}  // namespace revisit

#endif  // REVISIT_CORE_BASE_BUILD_INFO_H_
