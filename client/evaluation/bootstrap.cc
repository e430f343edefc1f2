#include "client/evaluation/bootstrap.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <set>
#include <utility>

#include "client/evaluation/calibration.h"
#include "client/evaluation/simulation.h"

namespace revisit::client {
namespace {

constexpr double kOutside = 0.025;
constexpr double kLeastDefined = 0.95;

// The counts to which a check adds.
struct Part {
  bool true_loop = false;
  bool accepted = false;
  bool accepted_correct = false;
  std::optional<Scored> stated;
};

Part PartOf(const JudgedCheck& check) {
  Part part;
  part.true_loop = check.true_loop;
  part.accepted = check.accepted();
  part.accepted_correct = check.accepted() && check.top_correct();
  if (!check.answer.candidates.empty() &&
      check.answer.candidates[0].probability.has_value()) {
    part.stated =
        Scored{*check.answer.candidates[0].probability, check.top_correct()};
  }
  return part;
}

void Add(const Part& part, Tally* tally) {
  tally->true_loops += part.true_loop;
  tally->accepted += part.accepted;
  tally->accepted_correct += part.accepted_correct;
  if (part.stated) tally->probabilities.push_back(*part.stated);
}

using Seeds = std::vector<std::vector<Part>>;

std::size_t MostChecks(const Seeds& seeds) {
  std::size_t most = 0;
  for (const std::vector<Part>& parts : seeds) {
    most = std::max(most, parts.size());
  }
  return most;
}

std::size_t ChecksOfBlock(const Seeds& seeds) {
  return std::clamp<std::size_t>(MostChecks(seeds) / 5, 1, kBlockChecks);
}

// Draws the blocks of one drive, at the same shares of the way of each seed.
void AddDraw(const Seeds& seeds, RandomSource* random, Tally* tally) {
  const std::size_t block = ChecksOfBlock(seeds);
  const std::size_t blocks = (MostChecks(seeds) + block - 1) / block;
  std::vector<double> begins(blocks);
  // In [0, 1): draws are multiples of 2^-53 above 0.
  for (double& begin : begins) {
    begin = random->Uniform() - 0x1p-53;
  }
  for (const std::vector<Part>& parts : seeds) {
    const std::size_t n = parts.size();
    for (std::size_t i = 0; i < n; ++i) {
      const auto begin =
          static_cast<std::size_t>(begins[i / block] * static_cast<double>(n));
      Add(parts[(begin + i % block) % n], tally);
    }
  }
}

std::optional<Interval> MiddleOf(std::vector<double> figures) {
  if (static_cast<double>(figures.size()) < kLeastDefined * kDraws) {
    return std::nullopt;
  }
  std::sort(figures.begin(), figures.end());
  const auto outside =
      static_cast<std::size_t>(kOutside * static_cast<double>(figures.size()));
  return Interval{figures[outside], figures[figures.size() - 1 - outside]};
}

// Blocks of one drive with a check that counts, in any seed.
std::size_t BlocksWith(const Seeds& seeds, bool Part::*counts) {
  std::set<std::size_t> blocks;
  const std::size_t block = ChecksOfBlock(seeds);
  for (const std::vector<Part>& parts : seeds) {
    for (std::size_t i = 0; i < parts.size(); ++i) {
      if (parts[i].*counts) blocks.insert(i / block);
    }
  }
  return blocks.size();
}

// The interval of a share of those that count.
std::optional<Interval> ShareInterval(const std::vector<Seeds>& drives,
                                      std::optional<double> share,
                                      bool Part::*counts,
                                      std::vector<double> drawn) {
  if (!share.has_value()) return std::nullopt;
  if (*share > 0.0 && *share < 1.0) return MiddleOf(std::move(drawn));
  std::size_t blocks = 0;
  for (const Seeds& seeds : drives) blocks += BlocksWith(seeds, counts);
  const double beyond = std::pow(kOutside, 1.0 / static_cast<double>(blocks));
  return *share > 0.0 ? Interval{beyond, 1.0} : Interval{0.0, 1.0 - beyond};
}

}  // namespace

FigureIntervals Bootstrap(const std::vector<ChecksOfSeeds>& drives) {
  std::vector<Seeds> parts;
  Tally all;
  for (const ChecksOfSeeds& seeds : drives) {
    Seeds& drive = parts.emplace_back();
    for (const std::vector<JudgedCheck>* checks : seeds) {
      std::vector<Part>& seed = drive.emplace_back();
      for (const JudgedCheck& check : *checks) {
        seed.push_back(PartOf(check));
        Add(seed.back(), &all);
      }
    }
  }
  std::vector<double> precision;
  std::vector<double> recall;
  std::vector<double> f1;
  std::vector<double> error;
  RandomSource random(1989);
  for (int draw = 0; draw < kDraws; ++draw) {
    Tally tally;
    for (const Seeds& seeds : parts) AddDraw(seeds, &random, &tally);
    const auto keep = [](std::optional<double> figure,
                         std::vector<double>* figures) {
      if (figure.has_value()) figures->push_back(*figure);
    };
    keep(tally.precision(), &precision);
    keep(tally.recall(), &recall);
    keep(tally.f1(), &f1);
    keep(tally.positive_calibration_error(), &error);
  }
  FigureIntervals intervals;
  intervals.precision = ShareInterval(parts, all.precision(), &Part::accepted,
                                      std::move(precision));
  intervals.recall =
      ShareInterval(parts, all.recall(), &Part::true_loop, std::move(recall));
  if (all.f1() == 1.0) {
    // Only where both of the others are.
    intervals.f1 = Interval{
        std::min(intervals.precision->low, intervals.recall->low), 1.0};
  } else if (all.f1() > 0.0) {
    intervals.f1 = MiddleOf(std::move(f1));
  }
  if (all.positive_calibration_error()) {
    intervals.positive_calibration_error = MiddleOf(std::move(error));
  }
  return intervals;
}

}  // namespace revisit::client
