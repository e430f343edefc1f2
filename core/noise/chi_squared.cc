#include "core/noise/chi_squared.h"

#include <boost/math/distributions/chi_squared.hpp>

namespace revisit::core {
namespace {

using boost::math::policies::ignore_error;
// In double precision, with relative errors below 1e-13: Boost would otherwise
// compute in long double, which takes eight times as long on x86 and is another
// type on each architecture.
using QuietPolicy = boost::math::policies::policy<
    boost::math::policies::domain_error<ignore_error>,
    boost::math::policies::pole_error<ignore_error>,
    boost::math::policies::overflow_error<ignore_error>,
    boost::math::policies::evaluation_error<ignore_error>,
    boost::math::policies::promote_double<false>>;
using ChiSquared = boost::math::chi_squared_distribution<double, QuietPolicy>;

}  // namespace

double ChiSquaredQuantile(double degrees_of_freedom, double probability) {
  return boost::math::quantile(ChiSquared(degrees_of_freedom), probability);
}

double ChiSquaredBelow(double degrees_of_freedom, double x) {
  return boost::math::cdf(ChiSquared(degrees_of_freedom), x);
}

double ChiSquaredAbove(double degrees_of_freedom, double x) {
  return boost::math::cdf(
      boost::math::complement(ChiSquared(degrees_of_freedom), x));
}

}  // namespace revisit::core
