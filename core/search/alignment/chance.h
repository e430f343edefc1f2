// How much of what speaks for a place comes by chance: of the shape's
// likelihood ratio, and of the heading.
//
// Where the vehicle is not, the ratio of the same road against another one
// (shape_filter.h) should be 1 on average: that is what makes it a likelihood
// ratio. Shapes are told apart by neighbouring turns alone, though, while roads
// repeat as a whole: the blocks of a grid are equally long. A path that many
// roads are like has a mean above 1 there, by which all of its ratios are too
// great. Other recordings have such roads enough to measure it: where they lie
// too far from the query for the vehicle to be there.
//
// Ratios that are e times as great are about e times as rare there, so each nat
// adds as much to the mean as the one before, and so many nodes show only its
// first part (kUnseenRatios). Ratios count up to the number of nodes: no more
// can be told from so many, and a road that the vehicle is on after all,
// farther off than its errors allow, does little harm.
//
// The density of nodes on roads not driven (relative_model.h) is that of roads
// which head any way alike. Roads of one town head like each other, though: in
// a grid there are but four ways, and that the query heads as a street says as
// little for this street as for the next one. With p the density at the query's
// heading, as far as it is known, of the headings on roads elsewhere, there are
// 2 pi p times as many new roads that head as the query does.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_CHANCE_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_CHANCE_H_

#include <cstddef>
#include <vector>

#include "core/drive/node_index.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/relative.h"
#include "core/search/alignment/relative_model.h"

namespace revisit::core {

// Nodes that are measured, at most, evenly spread over at most so many
// histories, which are evenly spread too.
inline constexpr NodeIndex kMostMeasured = 4096;
inline constexpr std::size_t kMostHistoriesMeasured = 16;

// By how much the mean of all ratios is above 1, to that of those which count.
// Chosen on two towns (tests/evaluation/RESULTS.md).
inline constexpr double kUnseenRatios = 2.0;

// Nodes beyond this squared Mahalanobis distance of position from the query are
// where the vehicle is not.
inline constexpr double kSquaredElsewhere = 16.0;

// Headings are compared with at least this standard deviation, rad: a street
// is not straight to a degree.
inline constexpr double kLeastHeadingDeviation = 0.02;

// Logarithms, each at least 0; 0 where nothing could be measured.
struct Chance {
  // The mean ratio's logarithm.
  double log_ratio = 0.0;
  // The logarithm of 2 pi p.
  double log_heading = 0.0;

  double log_odds() const { return log_ratio + log_heading; }
};

// Histories count that are other recordings, and tied to the query's. The model
// is theirs. `parts`, if not null, are those of an alignment with one of them,
// and have the recent path afterwards.
Chance MeasureChance(const Query& query, const std::vector<History>& histories,
                     const RelativeModel& model, AlignmentParts* parts);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_CHANCE_H_
