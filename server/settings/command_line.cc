#include "server/settings/command_line.h"

#include <CLI/CLI.hpp>
#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/build_info.h"
#include "core/base/command_words.h"
#include "core/base/suggestion.h"

namespace revisit::server {
namespace {

constexpr char kFooter[] =
    R"(Every setting is also a variable of the environment (--worker-threads is
REVISIT_WORKER_THREADS) and a key of the file that --config or REVISIT_CONFIG
names, with lines such as
  # Comments have lines of their own; strings may stand in double quotes.
  worker-threads = 4
Flags win over the environment, the environment over the file.

Once calls are taken, "listening on ADDRESS" is printed to standard output; logs
go to standard error. SIGTERM or SIGINT drains: health says NOT_SERVING; once
the notice, if there is one, is over, new calls are refused, streams get their
last acknowledgements, then the store is closed. SIGHUP has the files of keys,
certificates and policy looked at now.

Exit codes:
  0   stopped as told
  64  wrong usage or settings, or files of keys, certificates or policy that
      are no good
  65  the store is damaged: see "revisitd verify", and restore a backup
  69  cannot listen at the address, or write the port file
  73  the store is in use by another server, or is no store of this version
  74  the store cannot be read or written, or a flush failed

Examples:
  revisitd
  revisitd --listen 0.0.0.0:50051 --store /var/lib/revisit \
    --tls-cert server.crt --tls-key server.key --policy policy.json \
    --token-keys keys.json --token-issuer https://login.example \
    --token-audience revisit
  revisitd --worker-threads 2 --print-config > revisitd.conf
  revisitd backup --store /var/lib/revisit --to /backup/monday.sqlite
  revisitd verify --store /backup/monday.sqlite
  revisitd compact --store /var/lib/revisit
  revisitd migrate --store postgresql://db.example/revisit
  revisitd --store postgresql://db.example/revisit --advertise-address a:50051
  revisitd import --store postgresql://db.example/revisit \
    --from /var/lib/revisit
)";

CLI::Validator NotEmpty(const char* allowed) {
  return {[allowed](std::string& text) {
            return text.empty() ? absl::StrCat("got \"\"; allowed is ", allowed)
                                : std::string();
          },
          ""};
}

// CLI11 says that something is missing even if another word stands in its
// place.
std::string UsageMessage(const CLI::App& app, const CLI::Error& error) {
  const CLI::App* const chosen = ChosenOf(&app);
  const std::vector<std::string> words = app.remaining(/*recurse=*/true);
  if (std::string flag = MistypedFlag(words, chosen); !flag.empty()) {
    return flag;
  }
  if (words.empty()) return error.what();
  std::vector<std::string> commands;
  for (const CLI::App* command :
       chosen->get_subcommands([](const CLI::App*) { return true; })) {
    commands.push_back(command->get_name());
  }
  return MistypedWord(words.front(), commands);
}

}  // namespace

struct CommandLine::Parser {
  explicit Parser(CommandLine* owner) {
    app.name("revisitd");
    app.get_formatter()->column_width(kNameColumns);
    app.footer(kFooter);
    app.set_version_flag("--version", absl::StrCat("revisitd ", kVersionText));
    app.add_option("--config", owner->config_, "File of settings")
        ->type_name("FILE");
    app.add_flag("--print-config", owner->print_config_,
                 Wrapped("Print all settings in the form of the file, and "
                         "stop"));
    backup = app.add_subcommand("backup", "Copy the store and check the copy");
    backup->add_option("--to", other, "File to make")
        ->type_name("FILE")
        ->check(NotEmpty("the path of a file"))
        ->required();
    verify = app.add_subcommand("verify",
                                "Read the whole store and say what is wrong");
    compact =
        app.add_subcommand("compact", "Make the file of a stopped store small");
    migrate = app.add_subcommand("migrate",
                                 "Make or renew the tables of a shared store");
    import =
        app.add_subcommand("import", "Copy a store into one that is empty");
    import->add_option("--from", other, "Store to copy: a path or a URL")
        ->type_name("STORE")
        ->check(NotEmpty("a path, or postgresql://..."))
        ->required();
    for (CLI::App* subcommand : {backup, verify, compact, migrate, import}) {
      subcommand->fallthrough();
      subcommand->footer("--store and --config are those of revisitd itself.");
    }
    // The help lists groups in the order in which they were added.
    table.emplace(&app, &owner->settings_);
  }

  CLI::App app{
      "Keeps one pose graph per vehicle and answers where the vehicle has\n"
      "probably been before."};
  std::optional<OptionTable> table;
  CLI::App* backup = nullptr;
  CLI::App* verify = nullptr;
  CLI::App* compact = nullptr;
  CLI::App* migrate = nullptr;
  CLI::App* import = nullptr;
  std::string other;
};

CommandLine::CommandLine(const ServerSettings& settings)
    : settings_(settings), parser_(std::make_unique<Parser>(this)) {}

CommandLine::~CommandLine() = default;

OptionTable& CommandLine::table() { return *parser_->table; }

absl::Status CommandLine::Parse(const std::vector<std::string>& arguments) {
  CLI::App& app = parser_->app;
  CommandWords separated = SeparatedValues(app, arguments);
  if (!separated.problem.empty()) {
    return absl::InvalidArgumentError(separated.problem);
  }
  // CLI11 takes them from the back.
  std::reverse(separated.words.begin(), separated.words.end());
  try {
    app.parse(std::move(separated.words));
  } catch (const CLI::CallForHelp&) {
    print_ = app.help();
  } catch (const CLI::CallForVersion& version) {
    print_ = absl::StrCat(version.what(), "\n");
  } catch (const CLI::Error& error) {
    return absl::InvalidArgumentError(UsageMessage(app, error));
  }
  return absl::OkStatus();
}

std::optional<StoreTask> CommandLine::Task() const {
  for (const auto& [subcommand, kind] :
       {std::pair(parser_->backup, StoreTask::Kind::kBackup),
        std::pair(parser_->verify, StoreTask::Kind::kVerify),
        std::pair(parser_->compact, StoreTask::Kind::kCompact),
        std::pair(parser_->migrate, StoreTask::Kind::kMigrate),
        std::pair(parser_->import, StoreTask::Kind::kImport)}) {
    if (subcommand->parsed()) return StoreTask{kind, parser_->other};
  }
  return std::nullopt;
}

}  // namespace revisit::server
