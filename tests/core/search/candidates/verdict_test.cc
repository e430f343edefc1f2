#include "core/search/candidates/verdict.h"

#include <gtest/gtest.h>

namespace revisit::core {
namespace {

struct VerdictCase {
  const char* what;
  GateVerdict gate;
  // The gate's threshold is 7.8.
  double squared_end_difference;
  GateVerdict path_gate;
  double probability;
  Alternatives alternatives;
  Verdict verdict;
};

constexpr double kAcceptance = 0.6;
constexpr GateVerdict kPasses = GateVerdict::kAccepted;
constexpr GateVerdict kFails = GateVerdict::kRejected;

constexpr VerdictCase kVerdictCases[] = {
    {"probable", kPasses, 1.0, kPasses, 0.9, {0.1, 0.0}, Verdict::kAccepted},
    {"just probable enough",
     kPasses,
     1.0,
     kPasses,
     kAcceptance,
     {0.4, 0.0},
     Verdict::kAccepted},
    {"both outside the gate",
     kFails,
     7.9,
     kPasses,
     0.9,
     {0.1, 0.0},
     Verdict::kRejectedByGate},
    {"only the end pose outside the gate",
     kFails,
     7.8,
     kPasses,
     0.9,
     {0.1, 0.0},
     Verdict::kAccepted},
    {"nothing to decide by",
     GateVerdict::kIllConditioned,
     0.0,
     kPasses,
     0.9,
     {0.1, 0.0},
     Verdict::kIllConditioned},
    {"the gate comes before the path's",
     kFails,
     7.9,
     kFails,
     0.9,
     {0.1, 0.0},
     Verdict::kRejectedByGate},
    {"the path's gate comes before the probability",
     kPasses,
     1.0,
     kFails,
     0.9,
     {0.1, 0.0},
     Verdict::kRejectedByShape},
    {"as good as another",
     kPasses,
     1.0,
     kPasses,
     0.45,
     {0.5, 0.05},
     Verdict::kAmbiguous},
    {"hardly as good as another",
     kPasses,
     1.0,
     kPasses,
     0.0501,
     {0.5, 0.05},
     Verdict::kAmbiguous},
    {"not nearly as good as another",
     kPasses,
     1.0,
     kPasses,
     0.0499,
     {0.5, 0.05},
     Verdict::kRejectedByShape},
    {"another is accepted",
     kPasses,
     1.0,
     kPasses,
     0.3,
     {0.6, 0.05},
     Verdict::kRejectedByShape},
    {"too common a shape for ends that coincide",
     kPasses,
     0.0,
     kPasses,
     0.3,
     {0.0, 0.7},
     Verdict::kUninformative},
    {"enough had the ends coincided",
     kPasses,
     6.0,
     kPasses,
     0.3,
     {0.0, 0.7},
     Verdict::kRejectedByShape},
};

TEST(VerdictTest, TheFirstThatAppliesIsTaken) {
  for (const VerdictCase& wanted : kVerdictCases) {
    SCOPED_TRACE(wanted.what);
    GateResult gate;
    gate.threshold = 7.8;
    gate.verdict = wanted.gate;
    RelativeEvidence evidence;
    evidence.squared_end_difference = wanted.squared_end_difference;
    evidence.path_gate.verdict = wanted.path_gate;
    evidence.probability = wanted.probability;
    EXPECT_EQ(Decide(&gate, evidence, wanted.alternatives, kAcceptance),
              wanted.verdict);
  }
}

TEST(VerdictTest, TheGateAlone) {
  EXPECT_EQ(GateAlone(GateVerdict::kAccepted), Verdict::kAccepted);
  EXPECT_EQ(GateAlone(GateVerdict::kRejected), Verdict::kRejectedByGate);
  EXPECT_EQ(GateAlone(GateVerdict::kIllConditioned), Verdict::kIllConditioned);
}

}  // namespace
}  // namespace revisit::core
