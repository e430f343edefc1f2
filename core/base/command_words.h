// The words of a command line, before CLI11 reads them and where it has not
// understood them. CLI11 by itself takes the next word for the value of
// --flag=, and throws what is no error of its own where a flag without a value
// is given one.
#ifndef REVISIT_CORE_BASE_COMMAND_WORDS_H_
#define REVISIT_CORE_BASE_COMMAND_WORDS_H_

#include <string>
#include <vector>

namespace CLI {
class App;
class Option;
}  // namespace CLI

namespace revisit {

struct CommandWords {
  // In their order, without the name of the program.
  std::vector<std::string> words;
  // Says what is wrong with them; empty if CLI11 may read them.
  std::string problem;
  // The command that they lead to.
  const CLI::App* command = nullptr;
};

// The same words, with --flag= as two: the flag and an empty value. A value
// that is given to a flag without one is a problem.
CommandWords SeparatedValues(const CLI::App& app,
                             const std::vector<std::string>& words);

// The command that the words led to which `app` has parsed.
const CLI::App* ChosenOf(const CLI::App* app);

// The name of a command behind those of the commands above it.
std::string PathOf(const CLI::App* app);

// All names of an option, with their dashes.
std::vector<std::string> NamesOf(const CLI::Option* option);

// Says of a flag that there is not which one of the command, or of those above
// it, may be meant; empty if none of the words is a flag.
std::string MistypedFlag(const std::vector<std::string>& words,
                         const CLI::App* chosen);

}  // namespace revisit

#endif  // REVISIT_CORE_BASE_COMMAND_WORDS_H_
