#ifndef REVISIT_CORE_SEARCH_SHOULD_STOP_H_
#define REVISIT_CORE_SEARCH_SHOULD_STOP_H_

#include <functional>

namespace revisit::core {

// Called now and then during long work, which is given up once this returns
// true.
using ShouldStop = std::function<bool()>;

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_SHOULD_STOP_H_
