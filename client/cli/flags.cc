#include "client/cli/flags.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <utility>

#include "CLI/CLI.hpp"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_split.h"
#include "core/base/command_words.h"
#include "core/base/suggestion.h"

namespace revisit::client {
namespace {

// Takes decimal digits only: CLI11 by itself reads -1 as the largest number
// there is, and 010 as 8.
CLI::Validator WholeNumber(const WholeRange& range) {
  return {[range](std::string& text) {
            std::int64_t value = 0;
            const char* const end = text.data() + text.size();
            const auto [stop, error] = std::from_chars(text.data(), end, value);
            if (error != std::errc() || stop != end || value < range.lowest ||
                value > range.highest) {
              return absl::StrCat("got \"", text,
                                  "\"; allowed is a whole number in [",
                                  range.lowest, ", ", range.highest, "]");
            }
            text = std::to_string(value);
            return std::string();
          },
          ""};
}

CLI::Validator FiniteNumber(bool positive = false) {
  return {[positive](std::string& text) {
            double value = 0.0;
            if (CLI::detail::lexical_cast(text, value) &&
                std::isfinite(value) && (!positive || value > 0.0)) {
              return std::string();
            }
            return absl::StrCat("got \"", text,
                                "\"; allowed is a finite number",
                                positive ? " above 0" : "");
          },
          ""};
}

CLI::Validator OneOf(const std::vector<std::string>& words) {
  return {[words](std::string& text) {
            return std::find(words.begin(), words.end(), text) != words.end()
                       ? std::string()
                       : absl::StrCat("got \"", text, "\"; allowed is ",
                                      absl::StrJoin(words, ", "));
          },
          ""};
}

std::vector<std::string> KnownOf(const Words& words) {
  std::vector<std::string> known;
  for (const auto& [word, value] : words) known.push_back(word);
  return known;
}

// A word where a command is expected, or nothing there.
std::string MistypedCommand(
    const std::vector<std::string>& words,
    const std::vector<const CLI::App*>& commands,
    const std::map<const CLI::App*, CommandHelp>& helps) {
  std::vector<std::string> known;
  for (const CLI::App* command : commands) {
    if (!helps.at(command).hidden) known.push_back(command->get_name());
  }
  if (words.empty()) {
    return absl::StrCat("a command is missing; allowed is ",
                        absl::StrJoin(known, ", "));
  }
  return MistypedWord(words.front(), known);
}

// CLI11 says that something is missing even if another word stands in its
// place.
std::string UsageMessage(const CLI::App* app, const CLI::Error& error,
                         const std::map<const CLI::App*, CommandHelp>& helps) {
  const CLI::App* const chosen = ChosenOf(app);
  const std::vector<std::string> words = app->remaining(/*recurse=*/true);
  if (std::string flag = MistypedFlag(words, chosen); !flag.empty()) {
    return flag;
  }
  const auto commands =
      chosen->get_subcommands([](const CLI::App*) { return true; });
  if (error.get_name() == "RequiredError" && !commands.empty()) {
    return MistypedCommand(words, commands, helps);
  }
  if (error.get_exit_code() == static_cast<int>(CLI::ExitCodes::ExtrasError) &&
      !words.empty()) {
    return absl::StrCat("got \"", words.front(), "\", which ", PathOf(chosen),
                        " has no place for");
  }
  return error.what();
}

FlagUsage UsageOf(const CLI::Option* option) {
  FlagUsage usage;
  usage.names = NamesOf(option);
  if (option->get_positional()) usage.word = option->get_name(true);
  if (option->get_items_expected_max() > 0) {
    usage.value = option->get_type_name();
  }
  if (usage.value.find('|') != std::string::npos) {
    usage.choices = absl::StrSplit(usage.value, '|');
  }
  usage.help = option->get_description();
  usage.default_value = option->get_default_str();
  usage.environment = option->get_envname();
  usage.heading = option->get_group();
  usage.required = option->get_required();
  usage.repeated =
      option->get_items_expected_max() > 1 && option->get_delimiter() == '\0';
  return usage;
}

CommandUsage UsageOf(const CLI::App* app,
                     const std::map<const CLI::App*, CommandHelp>& helps) {
  const CommandHelp& help = helps.at(app);
  CommandUsage usage;
  usage.path = PathOf(app);
  usage.name = help.name;
  usage.summary = help.summary;
  usage.details = help.details;
  usage.examples = help.examples;
  usage.notes = help.notes;
  usage.hidden = help.hidden;
  for (const CLI::Option* option : app->get_options()) {
    usage.flags.push_back(UsageOf(option));
  }
  for (const CLI::App* command :
       app->get_subcommands([](const CLI::App*) { return true; })) {
    usage.commands.push_back(UsageOf(command, helps));
  }
  return usage;
}

// Throws what CLI11 throws itself.
void Apply(const Check& check) {
  if (check == nullptr) return;
  const std::string problem = check();
  if (!problem.empty()) throw CLI::ValidationError(problem);
}

}  // namespace

Flag Flag::Required() const {
  option_->required();
  return *this;
}

Flag Flag::Needs(const Flag& other) const {
  option_->needs(other.option_);
  return *this;
}

Flag Flag::ShowDefault() const {
  option_->capture_default_str();
  return *this;
}

Flag Flag::OrEnvironment(const std::string& variable) const {
  option_->envname(variable);
  return *this;
}

Command Command::AddCommand(const CommandHelp& help) const {
  app_->require_subcommand(1);
  CLI::App* const app = app_->add_subcommand(help.name, help.summary);
  shared_->helps[app] = help;
  return {app, shared_};
}

Command Command::Under(const std::string& heading) const {
  Command same = *this;
  same.heading_ = heading;
  return same;
}

Flag Command::AddText(const std::string& name, const std::string& type,
                      std::string* value, const std::string& help) const {
  return Flag(
      app_->add_option(name, *value, help)->type_name(type)->group(heading_));
}

Flag Command::AddText(const std::string& name, const std::string& type,
                      std::optional<std::string>* value,
                      const std::string& help) const {
  const auto set = [value](const std::string& text) { *value = text; };
  return Flag(app_->add_option_function<std::string>(name, set, help)
                  ->type_name(type)
                  ->group(heading_));
}

Flag Command::AddText(const std::string& name, const std::string& type,
                      std::function<std::string(const std::string&)> read,
                      const std::string& help) const {
  const auto check = [read = std::move(read)](std::string& text) {
    const std::string allowed = read(text);
    return allowed.empty()
               ? ""
               : absl::StrCat("got \"", text, "\"; allowed is ", allowed);
  };
  const auto set = [](const std::string&) {};
  return Flag(app_->add_option_function<std::string>(name, set, help)
                  ->type_name(type)
                  ->check(CLI::Validator(check, ""))
                  ->group(heading_));
}

Flag Command::AddTexts(const std::string& name, const std::string& type,
                       std::vector<std::string>* values,
                       const std::string& help) const {
  return Flag(
      app_->add_option(name, *values, help)->type_name(type)->group(heading_));
}

Flag Command::AddRepeatedText(const std::string& name, const std::string& type,
                              std::vector<std::string>* values,
                              const std::string& help) const {
  return Flag(app_->add_option(name, *values, help)
                  ->type_name(type)
                  ->allow_extra_args(false)
                  ->group(heading_));
}

Flag Command::AddSwitch(const std::string& name, bool* value,
                        const std::string& help) const {
  return Flag(app_->add_flag(name, *value, help)->group(heading_));
}

Flag Command::AddSwitch(const std::string& name, std::function<void(bool)> set,
                        const std::string& help) const {
  const auto count = [set = std::move(set)](std::int64_t given) {
    set(given > 0);
  };
  return Flag(app_->add_flag_function(name, count, help)->group(heading_));
}

Flag Command::AddChoice(const std::string& name, const Words& words,
                        std::function<void(int)> set,
                        const std::string& help) const {
  const auto set_word = [set = std::move(set), words](const std::string& word) {
    set(words.at(word));
  };
  const std::vector<std::string> known = KnownOf(words);
  return Flag(app_->add_option_function<std::string>(name, set_word, help)
                  ->type_name(absl::StrJoin(known, "|"))
                  ->check(OneOf(known))
                  ->group(heading_));
}

Flag Command::AddRepeatedChoice(const std::string& name, const Words& words,
                                std::function<void(int)> add,
                                const std::string& help) const {
  using Given = std::vector<std::string>;
  const auto add_words = [add = std::move(add), words](const Given& given) {
    for (const std::string& word : given) add(words.at(word));
  };
  const std::vector<std::string> known = KnownOf(words);
  return Flag(app_->add_option_function<Given>(name, add_words, help)
                  ->type_name(absl::StrJoin(known, "|"))
                  ->allow_extra_args(false)
                  ->check(OneOf(known))
                  ->group(heading_));
}

Flag Command::AddNumber(const std::string& name, const std::string& type,
                        double* value, const std::string& help) const {
  return Flag(app_->add_option(name, *value, help)
                  ->type_name(type)
                  ->check(FiniteNumber())
                  ->group(heading_)
                  ->capture_default_str());
}

Flag Command::AddNumber(const std::string& name, const std::string& type,
                        std::function<void(double)> set,
                        const std::string& help) const {
  return Flag(app_->add_option_function<double>(name, std::move(set), help)
                  ->type_name(type)
                  ->check(FiniteNumber())
                  ->group(heading_));
}

Flag Command::AddNumbers(const std::string& name, const std::string& type,
                         std::vector<double>* values,
                         const std::string& help) const {
  return AddNumbers(name, type, values, help, /*positive=*/false);
}

Flag Command::AddPositiveNumbers(const std::string& name,
                                 const std::string& type,
                                 std::vector<double>* values,
                                 const std::string& help) const {
  return AddNumbers(name, type, values, help, /*positive=*/true);
}

Flag Command::AddNumbers(const std::string& name, const std::string& type,
                         std::vector<double>* values, const std::string& help,
                         bool positive) const {
  return Flag(app_->add_option(name, *values, help)
                  ->type_name(type)
                  ->delimiter(',')
                  ->allow_extra_args(false)
                  ->check(FiniteNumber(positive))
                  ->group(heading_));
}

Flag Command::AddWholeNumber(const std::string& name, const WholeRange& range,
                             int* value, const std::string& help) const {
  return Flag(app_->add_option(name, *value, help)
                  ->type_name("N")
                  ->transform(WholeNumber(range))
                  ->group(heading_));
}

Flag Command::AddWholeNumber(const std::string& name, const WholeRange& range,
                             std::uint64_t* value,
                             const std::string& help) const {
  return Flag(app_->add_option(name, *value, help)
                  ->type_name("N")
                  ->transform(WholeNumber(range))
                  ->group(heading_));
}

Flag Command::AddWholeNumber(const std::string& name, const WholeRange& range,
                             std::function<void(std::int64_t)> set,
                             const std::string& help) const {
  return Flag(
      app_->add_option_function<std::int64_t>(name, std::move(set), help)
          ->type_name("N")
          ->transform(WholeNumber(range))
          ->group(heading_));
}

// The command itself or the one above it that has this flag; null if none has.
const CLI::App* Command::OwnerOf(const std::string& name) const {
  for (const CLI::App* app = app_; app != nullptr; app = app->get_parent()) {
    if (app->get_option_no_throw(name) != nullptr) return app;
  }
  return nullptr;
}

bool Command::Given(const std::string& name) const {
  const CLI::App* const owner = OwnerOf(name);
  return owner != nullptr && owner->get_option_no_throw(name)->count() > 0;
}

bool Command::Typed(const std::string& name) const {
  const CLI::App* const owner = OwnerOf(name);
  if (owner == nullptr) return false;
  // Options that the environment gives are not among those that were parsed.
  const std::vector<CLI::Option*>& typed = owner->parse_order();
  return std::find(typed.begin(), typed.end(),
                   owner->get_option_no_throw(name)) != typed.end();
}

bool Command::AsksForJson() const {
  return shared_->chosen.format == OutputFormat::kJson;
}

void Command::AlsoPrints(const std::vector<OutputFormat>& formats) const {
  shared_->formats[app_] = formats;
}

void Command::AddOutputFormat() const {
  Words words = {{"json", static_cast<int>(OutputFormat::kJson)},
                 {"text", static_cast<int>(OutputFormat::kText)}};
  std::string help = "What is printed: JSON, or text for people";
  for (const OutputFormat format : shared_->formats[app_]) {
    const bool wide = format == OutputFormat::kWide;
    words.emplace(wide ? "wide" : "name", static_cast<int>(format));
    help += wide ? "; wide is text with all columns" : "; name is names alone";
  }
  OutputFormat* const chosen = &shared_->chosen.format;
  Under("Output").AddChoice("-o", words, chosen, help);
  // Shells teach that -o=json is the same as -o json.
  app_->get_option("-o")->transform(CLI::Validator(
      [](std::string& word) {
        if (!word.empty() && word.front() == '=') word.erase(0, 1);
        return std::string();
      },
      ""));
}

void Command::Runs(const std::function<void()>& choose,
                   const Check& check) const {
  AddOutputFormat();
  const Check formats = [command = *this]() -> std::string {
    return command.Given("-o") && command.Given("--json")
               ? "-o, --json: one of them only"
               : "";
  };
  app_->callback([choose, check, formats] {
    Apply(formats);
    Apply(check);
    choose();
  });
}

void Command::Runs(Run run, const Check& check) const {
  Runs([chosen = &shared_->chosen, run = std::move(run)] { chosen->run = run; },
       check);
}

void Command::RunsAlone(RunAlone run, const Check& check) const {
  Runs([chosen = &shared_->chosen,
        run = std::move(run)] { chosen->run_alone = run; },
       check);
}

bool AsksForJson(int argc, const char* const* argv) {
  for (int i = 1; i < argc; ++i) {
    const std::string word = argv[i];
    if (word == "--json" || word == "-ojson" || word == "-o=json") return true;
    if (word == "-o" && i + 1 < argc && argv[i + 1] == std::string("json")) {
      return true;
    }
  }
  return false;
}

CommandLine::CommandLine(const CommandHelp& help)
    : app_(std::make_unique<CLI::App>(help.summary, help.name)),
      program_(app_.get(), &shared_) {
  shared_.helps[app_.get()] = help;
  app_->set_help_flag("-h,--help", "Print the help of the command");
  app_->set_version_flag("--version", "", "Print the version");
  program_.AddSwitch(
      "--json",
      [chosen = &shared_.chosen](bool) {
        chosen->format = OutputFormat::kJson;
      },
      "The same as -o json: print JSON; messages of the service as protobuf "
      "JSON");
  // All commands inherit what follows.
  app_->fallthrough();
}

CommandLine::~CommandLine() = default;

CommandUsage CommandLine::Usage() const {
  return UsageOf(app_.get(), shared_.helps);
}

absl::StatusOr<ParsedLine> CommandLine::Parse(int argc,
                                              const char* const* argv) {
  CommandWords separated = SeparatedValues(*app_, {argv + 1, argv + argc});
  if (!separated.problem.empty()) {
    return UsageError(separated.problem,
                      PathOf(separated.command) + " --help tells more");
  }
  // CLI11 takes them from the back.
  std::reverse(separated.words.begin(), separated.words.end());
  try {
    app_->parse(std::move(separated.words));
  } catch (const CLI::CallForHelp&) {
    shared_.chosen.help = UsageOf(ChosenOf(app_.get()), shared_.helps);
  } catch (const CLI::CallForVersion&) {
    shared_.chosen.version = true;
  } catch (const CLI::ParseError& error) {
    return UsageError(UsageMessage(app_.get(), error, shared_.helps),
                      PathOf(ChosenOf(app_.get())) + " --help tells more");
  }
  return shared_.chosen;
}

}  // namespace revisit::client
