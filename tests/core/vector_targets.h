// Runs a test with every vector instruction set of this machine.
#ifndef REVISIT_TESTS_CORE_VECTOR_TARGETS_H_
#define REVISIT_TESTS_CORE_VECTOR_TARGETS_H_

#include <gtest/gtest.h>
#include <hwy/highway.h>

namespace revisit::core {

template <typename Test>
void ForEachVectorTarget(const Test& test) {
  for (const auto target : hwy::SupportedAndGeneratedTargets()) {
    SCOPED_TRACE(hwy::TargetName(target));
    hwy::SetSupportedTargetsForTest(target);
    hwy::GetChosenTarget().Update(hwy::SupportedTargets());
    test();
  }
  hwy::SetSupportedTargetsForTest(0);
  hwy::GetChosenTarget().Update(hwy::SupportedTargets());
}

}  // namespace revisit::core

#endif  // REVISIT_TESTS_CORE_VECTOR_TARGETS_H_
