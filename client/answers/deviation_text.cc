#include "client/answers/deviation_text.h"

#include <cmath>
#include <cstddef>

#include "client/terminal/terminal.h"

namespace revisit::client {
namespace {

// Where the variances of x, y, z and the heading stand among the numbers of a
// form; below 0 for one that the form does not have.
struct Layout {
  v1::CovarianceForm form;
  int size;
  std::array<int, 4> variances;
};

constexpr Layout kLayouts[] = {
    {v1::COVARIANCE_FORM_PLANAR_6, 6, {0, 3, -1, 5}},
    {v1::COVARIANCE_FORM_SPATIAL_10, 10, {0, 4, 7, 9}},
    {v1::COVARIANCE_FORM_ROS_36, 36, {0, 7, 14, 35}}};

}  // namespace

std::array<std::string, 4> DeviationTexts(const v1::Covariance& covariance) {
  constexpr std::array<int, 4> kDigits = {3, 3, 3, 5};
  std::array<std::string, 4> texts = {"-", "-", "-", "-"};
  for (const Layout& layout : kLayouts) {
    if (layout.form != covariance.form()) continue;
    if (layout.size != covariance.values_size()) continue;
    for (std::size_t i = 0; i < texts.size(); ++i) {
      if (layout.variances[i] < 0) continue;
      const double variance = covariance.values(layout.variances[i]);
      texts[i] = Fixed(std::sqrt(variance), kDigits[i]);
    }
  }
  return texts;
}

}  // namespace revisit::client
