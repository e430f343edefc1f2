#include "client/cli/flags.h"

#include <charconv>
#include <cmath>
#include <utility>

#include "CLI/CLI.hpp"
#include "absl/strings/str_cat.h"

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

// Where a command is missing, CLI11 says so even if another word stands in its
// place.
std::string UsageMessage(const CLI::App* app, const CLI::Error& error) {
  const CLI::App* chosen = app;
  while (!chosen->get_subcommands().empty()) {
    chosen = chosen->get_subcommands().front();
  }
  std::string text = error.what();
  const auto commands =
      chosen->get_subcommands([](const CLI::App*) { return true; });
  if (error.get_name() == "RequiredError" && !commands.empty()) {
    const std::vector<std::string> words = app->remaining(true);
    text = words.empty() ? "a command is missing"
                         : absl::StrCat("got \"", words.front(), "\"");
    for (const CLI::App* command : commands) {
      absl::StrAppend(&text,
                      command == commands.front() ? "; allowed is " : ", ",
                      command->get_name());
    }
  }
  return text + "\nRun with --help for more information.\n";
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
  std::string footer = help.details;
  if (!help.examples.empty()) {
    absl::StrAppend(&footer, footer.empty() ? "" : "\n\n", "Examples:\n",
                    help.examples);
  }
  app->footer(footer);
  return {app, chosen_};
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

Flag Command::AddTexts(const std::string& name, const std::string& type,
                       std::vector<std::string>* values,
                       const std::string& help) const {
  return Flag(
      app_->add_option(name, *values, help)->type_name(type)->group(heading_));
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
  std::string type;
  std::vector<std::string> known;
  for (const auto& [word, value] : words) {
    absl::StrAppend(&type, type.empty() ? "" : "|", word);
    known.push_back(word);
  }
  const auto set_word = [set = std::move(set), words](const std::string& word) {
    set(words.at(word));
  };
  return Flag(app_->add_option_function<std::string>(name, set_word, help)
                  ->type_name(type)
                  ->check(CLI::IsMember(known).description(""))
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
  return Flag(app_->add_option(name, *values, help)
                  ->type_name(type)
                  ->delimiter(',')
                  ->allow_extra_args(false)
                  ->check(FiniteNumber())
                  ->group(heading_));
}

Flag Command::AddPositiveNumbers(const std::string& name,
                                 const std::string& type,
                                 std::vector<double>* values,
                                 const std::string& help) const {
  return Flag(app_->add_option(name, *values, help)
                  ->type_name(type)
                  ->delimiter(',')
                  ->allow_extra_args(false)
                  ->check(FiniteNumber(/*positive=*/true))
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

bool Command::Given(const std::string& name) const {
  for (const CLI::App* app = app_; app != nullptr; app = app->get_parent()) {
    if (const CLI::Option* flag = app->get_option_no_throw(name)) {
      return flag->count() > 0;
    }
  }
  return false;
}

void Command::Runs(Run run, Check check) const {
  app_->callback(
      [chosen = chosen_, run = std::move(run), check = std::move(check)] {
        if (check != nullptr) {
          const std::string problem = check();
          if (!problem.empty()) throw CLI::ValidationError(problem);
        }
        *chosen = run;
      });
}

CommandLine::CommandLine(const CommandHelp& help, const std::string& version)
    : app_(std::make_unique<CLI::App>(help.summary, help.name)),
      program_(app_.get(), &chosen_) {
  app_->footer(
      absl::StrCat("Examples:\n", help.examples, "\n\n", help.details));
  app_->set_version_flag("--version", version);
  // All commands inherit what follows.
  app_->fallthrough();
  app_->failure_message(UsageMessage);
}

CommandLine::~CommandLine() = default;

std::optional<int> CommandLine::Parse(int argc, char** argv) {
  try {
    app_->parse(argc, argv);
  } catch (const CLI::ParseError& error) {
    // Help and version are "errors" that exit with 0.
    return app_->exit(error) == 0 ? kExitOk : kExitUsage;
  }
  return std::nullopt;
}

}  // namespace revisit::client
