#include "tests/server/storage/postgres/postgres_server.h"

#include <fcntl.h>
#include <libpq-fe.h>
#include <pwd.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <thread>

#include "server/storage/postgres/migrations.h"

namespace revisit::server {
namespace {

[[noreturn]] void Die(const std::string& message) {
  std::fprintf(stderr, "PostgreSQL for tests: %s\n", message.c_str());
  std::abort();
}

// Where Debian keeps the programs of the newest version.
std::string FindPrograms() {
  std::string found;
  int newest = 0;
  std::error_code ignored;
  for (const auto& version :
       std::filesystem::directory_iterator("/usr/lib/postgresql", ignored)) {
    const int number = std::atoi(version.path().filename().c_str());
    const std::string programs = (version.path() / "bin").string();
    if (number > newest &&
        access((programs + "/postgres").c_str(), X_OK) == 0 &&
        access((programs + "/initdb").c_str(), X_OK) == 0) {
      newest = number;
      found = programs;
    }
  }
  return found;
}

// Memory, where there is enough of it: a database per test writes many files.
std::filesystem::path RoomyDirectory() {
  std::error_code error;
  const std::filesystem::path memory = "/dev/shm";
  const std::filesystem::space_info space =
      std::filesystem::space(memory, error);
  return !error && space.available > std::uintmax_t{2} << 30
             ? memory
             : std::filesystem::temp_directory_path();
}

// The user that the server belongs to if root runs the tests.
const passwd* OtherUser() {
  if (geteuid() != 0) return nullptr;
  for (const char* name : {"postgres", "nobody"}) {
    if (const passwd* user = getpwnam(name)) return user;
  }
  Die("root needs a user that is not root");
}

pid_t Launched(const std::vector<std::string>& command,
               const std::string& log) {
  const passwd* const user = OtherUser();
  const pid_t pid = fork();
  if (pid != 0) return pid;
  const int output = open(log.c_str(), O_WRONLY | O_CREAT | O_APPEND, 0666);
  dup2(output, STDOUT_FILENO);
  dup2(output, STDERR_FILENO);
  if (user != nullptr &&
      (setgid(user->pw_gid) != 0 || setuid(user->pw_uid) != 0)) {
    _exit(126);
  }
  // A test that is killed takes its server with it.
  prctl(PR_SET_PDEATHSIG, SIGQUIT);
  std::vector<char*> arguments;
  for (const std::string& argument : command) {
    arguments.push_back(const_cast<char*>(argument.c_str()));
  }
  arguments.push_back(nullptr);
  execv(arguments[0], arguments.data());
  _exit(127);
}

}  // namespace

PostgresServer::PostgresServer() : directory_(RoomyDirectory()) {}

std::unique_ptr<PostgresServer> PostgresServer::Start(
    const std::vector<std::string>& settings, std::string* missing) {
  const std::string programs = FindPrograms();
  if (programs.empty()) {
    *missing = "no /usr/lib/postgresql/*/bin/postgres (Debian: postgresql)";
    return nullptr;
  }
  std::unique_ptr<PostgresServer> server(new PostgresServer);
  server->programs_ = programs;
  const std::string directory = server->directory_.File("");
  if (const passwd* user = OtherUser()) {
    if (chown(directory.c_str(), user->pw_uid, user->pw_gid) != 0) {
      Die("cannot give away " + directory);
    }
  }
  const pid_t initdb =
      Launched({programs + "/initdb", "-D", server->directory_.File("data"),
                "-U", "tester", "-A", "trust", "-E", "UTF8", "--locale=C",
                "--no-sync", "--no-instructions"},
               server->directory_.File("log"));
  int status = 0;
  if (waitpid(initdb, &status, 0) != initdb || status != 0) {
    Die("initdb failed: see above, or try it by hand in " + programs);
  }
  // In the file, so that ALTER SYSTEM may override them.
  std::ofstream file(server->directory_.File("data/postgresql.conf"),
                     std::ios::app);
  file << "listen_addresses = ''\nunix_socket_directories = '" << directory
       << "'\nshared_buffers = 32MB\nmax_connections = 80\n"
       << "max_wal_size = 256MB\n";
  for (const std::string& setting : settings) file << setting << "\n";
  file.close();
  server->Launch();
  return server;
}

PostgresServer::~PostgresServer() { Stop(SIGINT); }

PostgresServer* PostgresServer::Shared() {
  static const std::unique_ptr<PostgresServer> server = [] {
    std::string missing;
    return Start({"fsync=off", "full_page_writes=off"}, &missing);
  }();
  return server.get();
}

void PostgresServer::Launch() {
  pid_ = Launched({programs_ + "/postgres", "-D", directory_.File("data")},
                  directory_.File("log"));
  const auto latest =
      std::chrono::steady_clock::now() + std::chrono::seconds(60);
  while (PQping(Conninfo("postgres").c_str()) != PQPING_OK) {
    if (std::chrono::steady_clock::now() > latest ||
        waitpid(pid_, nullptr, WNOHANG) != 0) {
      Die("the server does not start");
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
  }
}

void PostgresServer::Stop(int signal) {
  if (pid_ <= 0) return;
  kill(pid_, signal);
  waitpid(pid_, nullptr, 0);
  pid_ = -1;
}

void PostgresServer::Crash() {
  Stop(SIGQUIT);
  Launch();
}

std::string PostgresServer::Conninfo(const std::string& database) const {
  return "host=" + directory_.File("") + " user=tester dbname=" + database;
}

std::string PostgresServer::MakeStore() {
  if (!has_template_) {
    RunAsAdmin("CREATE DATABASE template_store");
    const auto migrated = MigrateDatabase(Conninfo("template_store"));
    if (!migrated.ok()) Die(std::string(migrated.status().message()));
    has_template_ = true;
  }
  const std::string name = "store_" + std::to_string(++databases_);
  RunAsAdmin("CREATE DATABASE " + name + " TEMPLATE template_store");
  return Conninfo(name);
}

std::string PostgresServer::MakeEmptyDatabase() {
  const std::string name = "empty_" + std::to_string(++databases_);
  RunAsAdmin("CREATE DATABASE " + name);
  return Conninfo(name);
}

std::string PostgresServer::RunAsAdmin(const std::string& sql) const {
  return Run(Conninfo("postgres"), sql);
}

std::string PostgresServer::Run(const std::string& conninfo,
                                const std::string& sql) const {
  const std::unique_ptr<PGconn, void (*)(PGconn*)> connection(
      PQconnectdb(conninfo.c_str()), PQfinish);
  const std::unique_ptr<PGresult, void (*)(PGresult*)> result(
      PQexec(connection.get(), sql.c_str()), PQclear);
  const ExecStatusType status = PQresultStatus(result.get());
  if (status != PGRES_TUPLES_OK && status != PGRES_COMMAND_OK) {
    Die(sql + ": " + PQerrorMessage(connection.get()));
  }
  std::string text;
  for (int row = 0; row < PQntuples(result.get()); ++row) {
    for (int column = 0; column < PQnfields(result.get()); ++column) {
      if (column > 0) text += "|";
      text += PQgetvalue(result.get(), row, column);
    }
    text += "\n";
  }
  return text;
}

}  // namespace revisit::server
