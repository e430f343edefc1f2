// Commands, flags and their help. CLI11 stays behind this interface because
// every file that includes it takes ten seconds longer to compile.
#ifndef REVISIT_CLIENT_CLI_FLAGS_H_
#define REVISIT_CLIENT_CLI_FLAGS_H_

#include <cstdint>
#include <functional>
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/cli/usage/command_usage.h"
#include "client/revisit/channel.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace CLI {
class App;
class Option;
}  // namespace CLI

namespace grpc {
class Channel;
}

namespace revisit::client {

// The server that the flags name. The channel connects when it is first used.
struct Connection {
  ChannelOptions options;
  std::shared_ptr<grpc::Channel> channel;
  // Calls over the channel.
  Client client;
};

// Executes a command after all flags have been read.
using Run = std::function<absl::Status(const Connection&, const Terminal&)>;

// The same for a command that asks no server.
using RunAlone = std::function<absl::Status(const Terminal&)>;

// Says what is wrong with the flags of a command taken together; empty if
// nothing is.
using Check = std::function<std::string()>;

// The words that a flag takes and the value that each one stands for.
using Words = std::map<std::string, int>;

// Both ends are allowed.
struct WholeRange {
  std::int64_t lowest = 0;
  std::int64_t highest = std::numeric_limits<std::int64_t>::max();
};

// The sequences of poses, as the service counts them.
inline constexpr WholeRange kSequences = {
    1, std::numeric_limits<std::int64_t>::max()};

// A flag that has been added to a command. Copies are the same flag.
class Flag {
 public:
  explicit Flag(CLI::Option* option) : option_(option) {}

  // A command line without this flag is refused.
  Flag Required() const;
  // Where this flag is given, `other` must be given as well.
  Flag Needs(const Flag& other) const;
  // The help shows the value that the variable of the flag has now.
  Flag ShowDefault() const;
  // The environment variable that counts where the flag is not given.
  Flag OrEnvironment(const std::string& variable) const;

 private:
  CLI::Option* option_;
};

// The help of a command.
struct CommandHelp {
  std::string name;
  // One line, also shown in the list of commands.
  std::string summary;
  // Above the flags; may be empty. Paragraphs, and lists whose lines begin with
  // blanks (usage/text_blocks.h); where lines end does not matter to the
  // former.
  std::string details;
  // Whole command lines, indented by two blanks; may be empty.
  std::string examples;
  // At the end, as the details; may be empty.
  std::string notes = "";
  // Whether lists of commands leave it out.
  bool hidden = false;
};

// The outcome of a command line.
struct ParsedLine {
  // The format that -o or --json ask for.
  OutputFormat format = OutputFormat::kText;
  // The help of this command, if it has a value.
  std::optional<CommandUsage> help;
  // The version of the program.
  bool version = false;
  // The chosen command; one of the two, unless something is asked for above.
  Run run;
  RunAlone run_alone;
};

// A command of a CommandLine, which must outlive it. Copies are the same
// command.
//
// `name` of a flag is as it is typed, such as "--json"; without dashes it is a
// word in its place among the others. `type` stands for the value in the help.
// A target of a flag must live until the command has run; it is left as it is
// where the flag is not given.
class Command {
 public:
  // Adds a command below this one, such as `create` to `vehicle`; a command
  // line then has to name one of those below.
  Command AddCommand(const CommandHelp& help) const;

  // The same command; flags added through it stand under `heading` in the help.
  Command Under(const std::string& heading) const;

  Flag AddText(const std::string& name, const std::string& type,
               std::string* value, const std::string& help) const;
  // Sets `value` also to an empty text, if that is what is given.
  Flag AddText(const std::string& name, const std::string& type,
               std::optional<std::string>* value,
               const std::string& help) const;
  // Hands the text to `read`, which says what is allowed in its place, or
  // nothing if it has taken it.
  Flag AddText(const std::string& name, const std::string& type,
               std::function<std::string(const std::string&)> read,
               const std::string& help) const;
  Flag AddTexts(const std::string& name, const std::string& type,
                std::vector<std::string>* values,
                const std::string& help) const;

  // A flag that may be given several times, with one value each.
  Flag AddRepeatedText(const std::string& name, const std::string& type,
                       std::vector<std::string>* values,
                       const std::string& help) const;

  // A flag without a value. "--x,!--no-x" makes --no-x set false.
  Flag AddSwitch(const std::string& name, bool* value,
                 const std::string& help) const;
  Flag AddSwitch(const std::string& name, std::function<void(bool)> set,
                 const std::string& help) const;

  // A flag that takes one of `words`.
  Flag AddChoice(const std::string& name, const Words& words,
                 std::function<void(int)> set, const std::string& help) const;
  template <typename Enum>
  Flag AddChoice(const std::string& name, const Words& words, Enum* value,
                 const std::string& help) const {
    return AddChoice(
        name, words, [value](int word) { *value = static_cast<Enum>(word); },
        help);
  }

  // A flag that may be given several times, with one of `words` each. `add` is
  // called for each.
  Flag AddRepeatedChoice(const std::string& name, const Words& words,
                         std::function<void(int)> add,
                         const std::string& help) const;

  // Finite numbers. The help shows the default of one that has a variable.
  Flag AddNumber(const std::string& name, const std::string& type,
                 double* value, const std::string& help) const;
  Flag AddNumber(const std::string& name, const std::string& type,
                 std::function<void(double)> set,
                 const std::string& help) const;
  // Numbers, separated by commas.
  Flag AddNumbers(const std::string& name, const std::string& type,
                  std::vector<double>* values, const std::string& help) const;
  // The same, all of them positive.
  Flag AddPositiveNumbers(const std::string& name, const std::string& type,
                          std::vector<double>* values,
                          const std::string& help) const;

  // Decimal digits only.
  Flag AddWholeNumber(const std::string& name, const WholeRange& range,
                      int* value, const std::string& help) const;
  Flag AddWholeNumber(const std::string& name, const WholeRange& range,
                      std::uint64_t* value, const std::string& help) const;
  Flag AddWholeNumber(const std::string& name, const WholeRange& range,
                      std::function<void(std::int64_t)> set,
                      const std::string& help) const;

  // Whether this flag, of the command or of one above it, was given: on the
  // command line, or by its environment variable.
  bool Given(const std::string& name) const;
  // Whether it was given on the command line.
  bool Typed(const std::string& name) const;
  // Whether -o or --json ask for JSON.
  bool AsksForJson() const;

  // Lets -o take these words beside "json" and "text", which it takes
  // everywhere. To be called before Runs().
  void AlsoPrints(const std::vector<OutputFormat>& formats) const;

  // Makes `run` what is to be run when this command was chosen and `check`
  // finds nothing wrong, and gives the command the flag -o.
  void Runs(Run run, const Check& check = nullptr) const;
  void RunsAlone(RunAlone run, const Check& check = nullptr) const;

 private:
  friend class CommandLine;
  // All commands of one CommandLine share this.
  struct Shared {
    ParsedLine chosen;
    std::map<const CLI::App*, CommandHelp> helps;
    // The formats that a command has beside text and JSON.
    std::map<const CLI::App*, std::vector<OutputFormat>> formats;
  };

  Flag AddNumbers(const std::string& name, const std::string& type,
                  std::vector<double>* values, const std::string& help,
                  bool positive) const;

  const CLI::App* OwnerOf(const std::string& name) const;
  void AddOutputFormat() const;
  // Calls `choose` when this command was chosen and nothing is wrong.
  void Runs(const std::function<void()>& choose, const Check& check) const;

  Command(CLI::App* app, Shared* shared) : app_(app), shared_(shared) {}

  CLI::App* app_;
  Shared* shared_;
  std::string heading_ = "Options";
};

// Whether the words of a command line ask for JSON, also where the line cannot
// be parsed.
bool AsksForJson(int argc, const char* const* argv);

// The program's name, its flags and its commands. Every program has --help,
// --version and --json.
class CommandLine {
 public:
  explicit CommandLine(const CommandHelp& help);
  ~CommandLine();

  CommandLine(const CommandLine&) = delete;
  CommandLine& operator=(const CommandLine&) = delete;

  // The program's own flags are taken before and after those of a command.
  const Command& program() const { return program_; }

  // Everything that was added.
  CommandUsage Usage() const;

  // Fills the targets of the flags. A UsageError (terminal.h) if the usage is
  // wrong. Call it once.
  absl::StatusOr<ParsedLine> Parse(int argc, const char* const* argv);

 private:
  const std::unique_ptr<CLI::App> app_;
  Command::Shared shared_;
  const Command program_;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_FLAGS_H_
