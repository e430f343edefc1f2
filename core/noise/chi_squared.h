// The chi-square distribution. Extreme arguments result in 0, 1, infinity or
// NaN, never in an exception.
#ifndef REVISIT_CORE_NOISE_CHI_SQUARED_H_
#define REVISIT_CORE_NOISE_CHI_SQUARED_H_

namespace revisit::core {

// Degrees of freedom are positive and need not be whole numbers.
double ChiSquaredQuantile(double degrees_of_freedom, double probability);
// P(X <= x) and P(X > x).
double ChiSquaredBelow(double degrees_of_freedom, double x);
double ChiSquaredAbove(double degrees_of_freedom, double x);

}  // namespace revisit::core

#endif  // REVISIT_CORE_NOISE_CHI_SQUARED_H_
