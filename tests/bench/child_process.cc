#include "tests/bench/child_process.h"

#include <fcntl.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <sstream>
#include <system_error>
#include <utility>

namespace revisit::bench {
namespace {

double Seconds(const timeval& time) {
  return static_cast<double>(time.tv_sec) +
         1e-6 * static_cast<double>(time.tv_usec);
}

std::string Folder(pid_t pid) { return "/proc/" + std::to_string(pid); }

// The folder below /proc is that of a process or of a thread.
double CpuSeconds(const std::filesystem::path& folder) {
  std::ifstream file(folder / "stat");
  std::string line;
  std::getline(file, line);
  // The name, in parentheses, may hold blanks; fields are counted behind it.
  const std::size_t name_end = line.rfind(')');
  if (name_end == std::string::npos) return 0.0;
  std::istringstream fields(line.substr(name_end + 1));
  const std::vector<std::string> values{
      std::istream_iterator<std::string>(fields), {}};
  if (values.size() < 13) return 0.0;
  const double ticks = std::stod(values[11]) + std::stod(values[12]);
  return ticks / static_cast<double>(sysconf(_SC_CLK_TCK));
}

double MemoryBytes(const std::filesystem::path& folder,
                   const std::string& field) {
  std::ifstream file(folder / "status");
  std::string word;
  while (file >> word) {
    double kilobytes = 0.0;
    if (word == field && file >> kilobytes) return 1024.0 * kilobytes;
  }
  return 0.0;
}

}  // namespace

void Die(const std::string& message) {
  std::fprintf(stderr, "revisit_server_bench: %s\n", message.c_str());
  // Children end with their parent.
  std::_Exit(1);
}

ChildProcess::ChildProcess(const std::vector<std::string>& command,
                           std::string log)
    : log_(std::move(log)) {
  std::vector<std::string> words = command;
  std::vector<char*> arguments;
  for (std::string& word : words) arguments.push_back(word.data());
  arguments.push_back(nullptr);
  int ends[2];
  if (pipe2(ends, O_CLOEXEC) != 0) Die("pipe failed");
  const int log_file =
      open(log_.c_str(), O_WRONLY | O_CREAT | O_CLOEXEC | O_TRUNC, 0600);
  if (log_file < 0) Die("cannot write " + log_);
  const pid_t parent = getpid();
  pid_ = fork();
  if (pid_ < 0) Die("fork failed");
  if (pid_ == 0) {
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    if (getppid() != parent) _exit(127);
    dup2(ends[1], STDOUT_FILENO);
    dup2(log_file, STDERR_FILENO);
    execv(arguments[0], arguments.data());
    _exit(127);
  }
  close(ends[1]);
  close(log_file);
  output_ = ends[0];
  // Other lines may come first.
  const std::string announcement = "\nlistening on ";
  std::string text = "\n";
  std::size_t begin = std::string::npos;
  while (begin == std::string::npos ||
         text.find('\n', begin) == std::string::npos) {
    char buffer[256];
    const ssize_t size = read(output_, buffer, sizeof(buffer));
    if (size < 0 && errno == EINTR) continue;
    if (size <= 0) Die(command[0] + " did not start:\n" + text + Log());
    text.append(buffer, static_cast<std::size_t>(size));
    begin = text.find(announcement);
    if (begin != std::string::npos) begin += announcement.size();
  }
  address_ = text.substr(begin, text.find('\n') - begin);
}

ChildProcess::~ChildProcess() { Stop(); }

double ChildProcess::cpu_seconds() const { return CpuSeconds(Folder(pid_)); }

double ChildProcess::thread_cpu_seconds(const std::string& name) const {
  double sum = 0.0;
  std::error_code error;
  for (const auto& task :
       std::filesystem::directory_iterator(Folder(pid_) + "/task", error)) {
    std::ifstream file(task.path() / "comm");
    std::string comm;
    if (std::getline(file, comm) && comm == name) {
      sum += CpuSeconds(task.path());
    }
  }
  return sum;
}

double ChildProcess::resident_bytes() const {
  return MemoryBytes(Folder(pid_), "VmRSS:");
}

double ChildProcess::peak_bytes() const {
  return MemoryBytes(Folder(pid_), "VmHWM:");
}

void ChildProcess::Stop() {
  if (pid_ > 0) {
    kill(pid_, SIGTERM);
    while (waitpid(pid_, nullptr, 0) < 0 && errno == EINTR) {
    }
  }
  pid_ = -1;
  if (output_ >= 0) close(output_);
  output_ = -1;
}

std::string ChildProcess::Log() const {
  std::ifstream file(log_, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

double OwnCpuSeconds() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  return Seconds(usage.ru_utime) + Seconds(usage.ru_stime);
}

ScratchDirectory::ScratchDirectory(const std::string& parent) {
  std::error_code error;
  const std::filesystem::path base =
      parent.empty() ? std::filesystem::temp_directory_path(error)
                     : std::filesystem::path(parent);
  path_ = (base / "revisit-bench-").string() + std::string(6, 'X');
  if (error || mkdtemp(path_.data()) == nullptr) {
    Die("cannot make a directory like " + path_);
  }
}

ScratchDirectory::~ScratchDirectory() {
  std::error_code error;
  std::filesystem::remove_all(path_, error);
}

}  // namespace revisit::bench
