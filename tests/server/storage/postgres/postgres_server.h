// A private PostgreSQL server for tests, in a temporary directory, reached over
// a socket file only.
#ifndef REVISIT_TESTS_SERVER_STORAGE_POSTGRES_POSTGRES_SERVER_H_
#define REVISIT_TESTS_SERVER_STORAGE_POSTGRES_POSTGRES_SERVER_H_

#include <sys/types.h>

#include <memory>
#include <string>
#include <vector>

#include "tests/server/temporary_directory.h"

namespace revisit::server {

class PostgresServer {
 public:
  // Null, with the reason in `*missing`, if PostgreSQL's server programs are
  // not installed. Dies if they do not work. `settings` are such as
  // "fsync=off". Run by root, the server is that of another user, since it
  // refuses root.
  static std::unique_ptr<PostgresServer> Start(
      const std::vector<std::string>& settings, std::string* missing);
  // Stops it.
  ~PostgresServer();

  PostgresServer(const PostgresServer&) = delete;
  PostgresServer& operator=(const PostgresServer&) = delete;

  // The one that all tests of a program share, which trades durability for
  // speed; null if PostgreSQL is not installed.
  static PostgresServer* Shared();

  // Makes a database with the tables of a store, and one without any; returns
  // its conninfo.
  std::string MakeStore();
  std::string MakeEmptyDatabase();

  // Runs SQL; returns the values, "|" between columns and "\n" between rows.
  // Dies of an error.
  std::string Run(const std::string& conninfo, const std::string& sql) const;
  // On the database that every server has.
  std::string RunAsAdmin(const std::string& sql) const;

  // Ends the server at once, without a checkpoint, and starts it again.
  void Crash();

 private:
  PostgresServer();

  void Launch();
  void Stop(int signal);
  std::string Conninfo(const std::string& database) const;

  TemporaryDirectory directory_;
  std::string programs_;
  pid_t pid_ = -1;
  int databases_ = 0;
  bool has_template_ = false;
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_STORAGE_POSTGRES_POSTGRES_SERVER_H_
