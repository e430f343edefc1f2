// How error messages show numbers.
#ifndef REVISIT_CORE_BASE_NUMBER_TEXT_H_
#define REVISIT_CORE_BASE_NUMBER_TEXT_H_

#include <cstdio>
#include <string>

namespace revisit::core {

// At most nine significant digits, which show by how much a bound was missed.
inline std::string NumberText(double value) {
  char text[32];
  std::snprintf(text, sizeof(text), "%.9g", value);
  return text;
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_BASE_NUMBER_TEXT_H_
