// Whether a recording looks like a vehicle's, read by the conventions that were
// given: wrong axes, units and orders would otherwise be taken for a drive like
// any other.
//
// Only what is certain is suspicious. Heading is compared with the course over
// steps of 2 m, which noise of positions spoils, and of 20 m, which turning on
// the spot spoils; both must disagree. Suspicion names what was seen and, where
// another reading of the same samples fits, the flag for it: that of another
// convention, or that of how the body is turned in the vehicle (body_turn.h).
#ifndef REVISIT_CLIENT_FORMATS_PLAUSIBILITY_H_
#define REVISIT_CLIENT_FORMATS_PLAUSIBILITY_H_

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "client/formats/axes.h"
#include "client/formats/body_turn.h"
#include "client/formats/sample.h"

namespace revisit::client {

// Headings against courses over steps of one length.
class CourseStatistics {
 public:
  explicit CourseStatistics(double step_meters) : step_meters_(step_meters) {}

  void Add(const Sample& sample);

  std::int64_t steps() const { return steps_; }
  // Whether more than a quarter of the steps rise or fall more than they go
  // forward.
  bool IsSteep() const { return 4 * steep_ > steps_; }
  // In degrees; absent without a heading to compare.
  std::optional<double> Median() const;
  // Whether more than half of the steps took longer than any vehicle's.
  bool IsCrawling() const { return timed_ >= 10 && 2 * crawling_ > timed_; }

 private:
  const double step_meters_;
  std::optional<Sample> anchor_;
  std::int64_t steps_ = 0;
  std::int64_t steep_ = 0;
  std::int64_t timed_ = 0;
  std::int64_t crawling_ = 0;
  std::int64_t compared_ = 0;
  std::array<std::int64_t, 181> by_degree_{};
};

// The samples read by some conventions.
struct Reading {
  Conventions conventions;
  // The flag for them, and what it means.
  std::string flag;
  std::string words;
  // False if the samples cannot be read so.
  bool possible = true;
  CourseStatistics near{2.0};
  CourseStatistics far{20.0};
  // How the body is turned if all else is so, over steps as long as above.
  // Looked for only at the beginning.
  bool seeks_turn = true;
  BodyTurn near_turn{2.0};
  BodyTurn far_turn{20.0};
  // Samples with a full orientation, and those of them whose up axis leans more
  // than 45 degrees.
  std::int64_t oriented = 0;
  std::int64_t leaning = 0;

  void Add(const Sample& raw);
  bool IsLeaning() const { return oriented >= 20 && 2 * leaning > oriented; }
  // Whether heading and course disagree, or z is no height. `complete` if no
  // more samples follow.
  bool IsWrong(bool complete) const;
  bool Fits() const;
  // The turn of the body with which the samples fit.
  std::optional<BodyTurn::Finding> Turn() const;
};

class Plausibility {
 public:
  // `path` is for messages.
  Plausibility(const Conventions& conventions, const std::string& path);

  // Takes the next sample, before it is converted; x and y of geodetic ones
  // are metres. INVALID_ARGUMENT as soon as something is suspicious.
  absl::Status Observe(const Sample& raw);
  // The same for what only the whole shows.
  absl::Status Finish();

 private:
  absl::Status CheckTime(const Sample& raw);
  absl::Status CheckSpeeds();
  absl::Status CheckKilometers();
  absl::Status CheckDegrees();
  absl::Status CheckEarthCentred();
  // Checks positions and times, which need no convention.
  absl::Status CheckPositions();
  // Adds what the sample adds to the counts below.
  void Count(const Sample& raw);
  void CountStep(const Sample& raw);
  absl::Status CheckReadings(bool complete);
  absl::Status CheckYaw(bool complete);
  absl::Status Suspicious(const std::string& seen,
                          const std::string& mend) const;
  std::string MendOf() const;
  // The reading that fits best as it is, and what fits best with a turned body,
  // preferably by the conventions that were given; null and empty if none does.
  const Reading* BestReading() const;
  std::string BestTurn(double* spread_degrees) const;

  const std::string path_;
  // The given one first, then those that another flag would give.
  std::vector<Reading> readings_;
  std::int64_t samples_ = 0;
  std::int64_t line_ = 0;
  std::optional<Sample> previous_;
  // Between neighbours.
  std::int64_t moved_ = 0;
  std::int64_t timed_ = 0;
  std::int64_t fast_ = 0;
  double path_length_ = 0.0;
  std::int64_t slow_ = 0;
  double slow_seconds_ = 0.0;
  // Over every tenth sample: as long as the path if that is smooth.
  double coarse_length_ = 0.0;
  std::optional<Sample> coarse_;
  // From the origin of the frame to the nearest and to the farthest position.
  double least_radius_ = 0.0;
  double largest_radius_ = 0.0;
  bool geodetic_ = false;
  double low_[2] = {};
  double high_[2] = {};
  double largest_yaw_ = 0.0;
  // Steps of 20 m at which the readings are looked at again.
  std::int64_t next_look_ = 8;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_PLAUSIBILITY_H_
