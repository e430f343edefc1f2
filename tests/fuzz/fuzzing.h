// Shared by the fuzz targets.
#ifndef REVISIT_TESTS_FUZZ_FUZZING_H_
#define REVISIT_TESTS_FUZZ_FUZZING_H_

#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>

#include "absl/status/status.h"

namespace revisit::fuzz {

// Ends the process unless a condition holds that no input may break.
inline void Require(bool holds, const char* what) {
  if (holds) return;
  std::fprintf(stderr, "does not hold: %s\n", what);
  std::abort();
}

// Takes an input apart: first some choices, then the rest as it is.
class Input {
 public:
  Input(const std::uint8_t* data, std::size_t size)
      : data_(reinterpret_cast<const char*>(data)), size_(size) {}

  // In [0, choices).
  int Choice(int choices) {
    if (size_ == 0) return 0;
    const auto byte = static_cast<std::uint8_t>(*data_);
    ++data_;
    --size_;
    return byte % choices;
  }

  std::string Rest() const { return std::string(data_, size_); }

 private:
  const char* data_;
  std::size_t size_;
};

}  // namespace revisit::fuzz

// The entry point that libFuzzer asks for.
extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data,
                                      std::size_t size);

#endif  // REVISIT_TESTS_FUZZ_FUZZING_H_
