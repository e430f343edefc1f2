// The server's settings: a file, a variable and a flag, one a line group.
#include <fcntl.h>
#include <sys/mman.h>
#include <unistd.h>

#include <string>
#include <vector>

#include "server/settings/settings.h"
#include "tests/fuzz/fuzzing.h"

namespace {

using revisit::fuzz::Require;

// A file in memory.
class TextFile {
 public:
  explicit TextFile(const std::string& text)
      : descriptor_(memfd_create("settings", 0)) {
    Require(write(descriptor_, text.data(), text.size()) ==
                static_cast<ssize_t>(text.size()),
            "the file is written");
  }
  ~TextFile() { close(descriptor_); }
  TextFile(const TextFile&) = delete;
  TextFile& operator=(const TextFile&) = delete;

  std::string path() const {
    return "/proc/self/fd/" + std::to_string(descriptor_);
  }

 private:
  const int descriptor_;
};

// Up to the next zero byte.
std::string Cut(std::string* rest) {
  const std::size_t end = rest->find('\0');
  const std::string part = rest->substr(0, end);
  *rest = end == std::string::npos ? "" : rest->substr(end + 1);
  return part;
}

// Those would read files of this machine.
bool NamesAFile(const std::string& text) {
  return text.find("config") != std::string::npos ||
         text.find("CONFIG") != std::string::npos;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data,
                                      std::size_t size) {
  namespace server = revisit::server;
  std::string rest = revisit::fuzz::Input(data, size).Rest();
  const std::string variable = Cut(&rest);
  const std::string flag = Cut(&rest);
  if (NamesAFile(variable) || NamesAFile(flag)) return 0;
  const TextFile file(rest);
  std::vector<std::string> arguments = {"--config", file.path()};
  if (!flag.empty()) arguments.push_back(flag);
  const auto parsed = server::ParseSettings(arguments, {variable});
  if (!parsed.ok()) {
    Require(absl::IsInvalidArgument(parsed.status()),
            "bad settings are INVALID_ARGUMENT");
    Require(!parsed.status().message().empty(), "a refusal has words");
    return 0;
  }
  if (parsed->print) return 0;
  const std::string printed = server::PrintSettings(parsed->settings);
  const TextFile copy(printed);
  const auto again = server::ParseSettings({"--config", copy.path()}, {});
  Require(again.ok(), "printed settings can be read");
  Require(server::PrintSettings(again->settings) == printed,
          "printed settings read back as the same");
  return 0;
}
