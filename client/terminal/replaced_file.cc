#include "client/terminal/replaced_file.h"

#include <fcntl.h>
#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <cstdlib>
#include <filesystem>

#include "client/terminal/file_error.h"

namespace revisit::client {
namespace {

absl::Status WriteDurably(int file, const std::string& text,
                          const std::string& path) {
  for (std::size_t done = 0; done < text.size();) {
    const ssize_t wrote = write(file, text.data() + done, text.size() - done);
    if (wrote < 0 && errno == EINTR) continue;
    if (wrote < 0) return FileError(path, errno);
    done += static_cast<std::size_t>(wrote);
  }
  return fsync(file) == 0 ? absl::OkStatus() : FileError(path, errno);
}

// The new name is on the disk once the folder is. One that cannot be flushed,
// as on some file systems of networks, keeps the file all the same.
void FlushFolderOf(const std::string& path) {
  const std::string folder = std::filesystem::path(path).parent_path().string();
  const int opened = open(folder.empty() ? "." : folder.c_str(),
                          O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (opened < 0) return;
  (void)fsync(opened);
  close(opened);
}

}  // namespace

absl::Status ReplaceFile(const std::string& path, const std::string& text) {
  std::string aside = path + ".XXXXXX";
  // Nobody else may read such a file from its beginning on.
  const int file = mkostemp(aside.data(), O_CLOEXEC);
  if (file < 0) return FileError(path, errno);
  absl::Status done = WriteDurably(file, text, path);
  close(file);
  if (done.ok() && std::rename(aside.c_str(), path.c_str()) != 0) {
    done = FileError(path, errno);
  }
  if (!done.ok()) {
    std::remove(aside.c_str());
    return done;
  }
  FlushFolderOf(path);
  return done;
}

}  // namespace revisit::client
