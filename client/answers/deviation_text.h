// Standard deviations, printed for people.
#ifndef REVISIT_CLIENT_ANSWERS_DEVIATION_TEXT_H_
#define REVISIT_CLIENT_ANSWERS_DEVIATION_TEXT_H_

#include <array>
#include <string>

#include "revisit/v1/geometry.pb.h"

namespace revisit::client {

// Standard deviations of x, y and z (metres) and of the heading (radians); "-"
// for each that the covariance does not have. Takes anything that a server may
// send.
std::array<std::string, 4> DeviationTexts(const v1::Covariance& covariance);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_ANSWERS_DEVIATION_TEXT_H_
