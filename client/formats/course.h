// Headings of samples that have none, for a vehicle that faces where it moves.
//
// With a velocity, heading is its direction, and the variance of heading that
// of the velocity across, over the speed squared. A sample slower than the
// standstill speed shows neither heading nor progress, and the wandering of its
// position would count as travelled distance: it is left out.
//
// Without a velocity, samples less than two metres from the last one that was
// kept, or slower than the standstill speed since the one before, are left out.
// Heading is the direction from the sample that was kept before to the one that
// is kept next, which is waited for. Its variance is that of the two positions
// across, over the distance squared.
#ifndef REVISIT_CLIENT_FORMATS_COURSE_H_
#define REVISIT_CLIENT_FORMATS_COURSE_H_

#include <memory>

#include "client/formats/reader.h"

namespace revisit::client {

inline constexpr double kStandstillMetersPerSecond = 0.5;
inline constexpr double kCourseMeters = 2.0;
// Samples that are farther apart are no neighbours: a jump has no course.
inline constexpr double kLongestCourseMeters = 100.0;
// Standard deviations where a file states none: of each component of a
// velocity, and of one position against the next.
inline constexpr double kVelocitySigma = 0.2;
inline constexpr double kNeighbourSigmaMeters = 0.5;

// Samples that have a heading pass unchanged. `covariance` is made of that of
// the position, where there is one, and that of heading.
std::unique_ptr<SampleReader> AddCourse(std::unique_ptr<SampleReader> reader);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_COURSE_H_
