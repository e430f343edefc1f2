#include "client/terminal/shell_command.h"

#include <spawn.h>
#include <sys/mman.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <csignal>
#include <cstring>

#include "absl/strings/str_cat.h"
#include "client/terminal/terminal.h"

extern char** environ;

namespace revisit::client {
namespace {

absl::Status CommandError(const std::string& what, int error) {
  return LocalError(
      absl::UnknownError(absl::StrCat(what, ": ", std::strerror(error))));
}

// A file without a name that holds the text, to be read from its beginning on;
// -1 if there can be none. Unlike a pipe it takes all of the text whether
// somebody reads it or not.
int HeldInFile(const std::string& text) {
  const int file = memfd_create("input", MFD_CLOEXEC);
  if (file < 0) return file;
  for (std::size_t done = 0; done < text.size();) {
    const ssize_t wrote = write(file, text.data() + done, text.size() - done);
    if (wrote < 0 && errno == EINTR) continue;
    if (wrote < 0) {
      close(file);
      return -1;
    }
    done += static_cast<std::size_t>(wrote);
  }
  lseek(file, 0, SEEK_SET);
  return file;
}

// Starts the command. An error number, or 0.
int Start(const std::string& command, int input, pid_t* child) {
  posix_spawn_file_actions_t files;
  posix_spawn_file_actions_init(&files);
  posix_spawn_file_actions_adddup2(&files, input, STDIN_FILENO);
  posix_spawn_file_actions_adddup2(&files, STDERR_FILENO, STDOUT_FILENO);
  // Whoever writes to a pipe that nobody reads ends by it, as in a shell.
  posix_spawnattr_t attributes;
  posix_spawnattr_init(&attributes);
  sigset_t defaults;
  sigemptyset(&defaults);
  sigaddset(&defaults, SIGPIPE);
  posix_spawnattr_setsigdefault(&attributes, &defaults);
  posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETSIGDEF);
  const char* const words[] = {"sh", "-c", command.c_str(), nullptr};
  const int error = posix_spawn(child, "/bin/sh", &files, &attributes,
                                const_cast<char* const*>(words), environ);
  posix_spawnattr_destroy(&attributes);
  posix_spawn_file_actions_destroy(&files);
  return error;
}

}  // namespace

std::string CommandEnd::text() const {
  return signal == 0
             ? absl::StrCat("exit code ", exit_code)
             : absl::StrCat("signal ", signal, " (", strsignal(signal), ")");
}

absl::StatusOr<CommandEnd> RunShellCommand(const std::string& command,
                                           const std::string& input) {
  const int file = HeldInFile(input);
  if (file < 0) return CommandError("input of a command", errno);
  pid_t child = 0;
  const int error = Start(command, file, &child);
  close(file);
  if (error != 0) return CommandError("/bin/sh", error);
  int end = 0;
  while (waitpid(child, &end, 0) < 0) {
    if (errno != EINTR) return CommandError("/bin/sh", errno);
  }
  CommandEnd ended;
  if (WIFSIGNALED(end)) {
    ended.signal = WTERMSIG(end);
  } else {
    ended.exit_code = WEXITSTATUS(end);
  }
  return ended;
}

}  // namespace revisit::client
