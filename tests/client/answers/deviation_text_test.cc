#include "client/answers/deviation_text.h"

#include "gmock/gmock.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using ::testing::ElementsAre;

// A covariance of this form whose i-th number is the square of i + 1.
v1::Covariance Squares(v1::CovarianceForm form, int count) {
  v1::Covariance covariance;
  covariance.set_form(form);
  for (int i = 1; i <= count; ++i) covariance.add_values(i * i);
  return covariance;
}

TEST(DeviationTextTest, EveryFormHasItsVariancesWhereTheProtoSays) {
  EXPECT_THAT(DeviationTexts(Squares(v1::COVARIANCE_FORM_PLANAR_6, 6)),
              ElementsAre("1.000", "4.000", "-", "6.00000"));
  EXPECT_THAT(DeviationTexts(Squares(v1::COVARIANCE_FORM_SPATIAL_10, 10)),
              ElementsAre("1.000", "5.000", "8.000", "10.00000"));
  EXPECT_THAT(DeviationTexts(Squares(v1::COVARIANCE_FORM_ROS_36, 36)),
              ElementsAre("1.000", "8.000", "15.000", "36.00000"));
}

TEST(DeviationTextTest, CovarianceThatIsNoneHasNoDeviations) {
  const auto none = ElementsAre("-", "-", "-", "-");
  EXPECT_THAT(DeviationTexts(v1::Covariance()), none);
  EXPECT_THAT(DeviationTexts(Squares(v1::COVARIANCE_FORM_ROS_36, 6)), none);
}

}  // namespace
}  // namespace revisit::client
