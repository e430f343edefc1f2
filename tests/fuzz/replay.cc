// Runs a fuzz target without libFuzzer: over all files of its corpus, and over
// random changes of each.
//
//   TARGET [-changes=N] [-seed=N] FILE_OR_DIRECTORY...
#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <random>
#include <string>
#include <vector>

#include "tests/fuzz/fuzzing.h"

namespace {

using Bytes = std::vector<std::uint8_t>;

Bytes Read(const std::filesystem::path& path) {
  std::ifstream file(path, std::ios::binary);
  return Bytes(std::istreambuf_iterator<char>(file), {});
}

void Run(const Bytes& input) {
  LLVMFuzzerTestOneInput(input.data(), input.size());
}

// A few bytes changed, left out, doubled, or taken from another input.
Bytes Changed(Bytes bytes, const Bytes& other, std::mt19937_64* random) {
  const auto below = [&](std::size_t count) {
    return static_cast<std::ptrdiff_t>((*random)() %
                                       std::max<std::size_t>(count, 1));
  };
  for (auto changes = 1 + below(4); changes > 0; --changes) {
    if (bytes.empty()) bytes.push_back(0);
    const auto at = bytes.begin() + below(bytes.size());
    switch (below(6)) {
      case 0:
        *at = static_cast<std::uint8_t>(*at ^ (1u << below(8)));
        break;
      case 1:
        *at = static_cast<std::uint8_t>(below(256));
        break;
      case 2:
        bytes.erase(
            at, at + std::min<std::ptrdiff_t>(1 + below(8), bytes.end() - at));
        break;
      case 3:
        bytes.insert(at, static_cast<std::size_t>(1 + below(8)),
                     static_cast<std::uint8_t>(below(256)));
        break;
      case 4: {
        const Bytes piece(
            at, at + std::min<std::ptrdiff_t>(1 + below(64), bytes.end() - at));
        bytes.insert(bytes.begin() + below(bytes.size()), piece.begin(),
                     piece.end());
        break;
      }
      default:
        if (!other.empty()) {
          const auto from = other.begin() + below(other.size());
          bytes.insert(at, from,
                       from + std::min<std::ptrdiff_t>(1 + below(64),
                                                       other.end() - from));
        }
    }
  }
  return bytes;
}

}  // namespace

int main(int argc, char** argv) {
  long changes = 0;
  unsigned long seed = 20101018;
  std::vector<std::filesystem::path> files;
  for (int i = 1; i < argc; ++i) {
    const std::string argument = argv[i];
    if (argument.rfind("-changes=", 0) == 0) {
      changes = std::atol(argument.c_str() + 9);
    } else if (argument.rfind("-seed=", 0) == 0) {
      seed = std::strtoul(argument.c_str() + 6, nullptr, 10);
    } else if (std::filesystem::is_directory(argument)) {
      for (const auto& entry : std::filesystem::directory_iterator(argument)) {
        files.push_back(entry.path());
      }
    } else {
      files.emplace_back(argument);
    }
  }
  std::sort(files.begin(), files.end());
  std::vector<Bytes> inputs;
  for (const std::filesystem::path& file : files) inputs.push_back(Read(file));
  if (inputs.empty()) {
    std::fprintf(stderr, "no inputs\n");
    return 1;
  }
  for (const Bytes& input : inputs) Run(input);
  std::mt19937_64 random(seed);
  for (long i = 0; i < changes; ++i) {
    for (const Bytes& input : inputs) {
      const Bytes input_changed =
          Changed(input, inputs[random() % inputs.size()], &random);
      // Found again by the file, should this one end the process.
      if (std::getenv("REVISIT_FUZZ_LAST") != nullptr) {
        std::ofstream(std::getenv("REVISIT_FUZZ_LAST"), std::ios::binary)
            .write(reinterpret_cast<const char*>(input_changed.data()),
                   static_cast<std::streamsize>(input_changed.size()));
      }
      Run(input_changed);
    }
  }
  std::printf("%zu inputs, %ld changes of each, seed %lu\n", inputs.size(),
              changes, seed);
  return 0;
}
