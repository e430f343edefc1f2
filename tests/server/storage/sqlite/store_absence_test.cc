// Each file of a store missing, empty, older or of another store, in every
// combination: what is served is right, or the store is refused.
//
// It went wrong once: a database that was missing or empty beside a sound log
// was taken for a new store, and the log removed.
#include <algorithm>
#include <array>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <memory>
#include <optional>
#include <sstream>
#include <string>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/storage/sqlite/sqlite_database.h"
#include "server/storage/sqlite/sqlite_storage.h"
#include "server/storage/sqlite/store_backup.h"
#include "server/storage/sqlite/store_check.h"
#include "server/storage/sqlite/store_files.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage_testing.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::AllOf;
using ::testing::HasSubstr;

constexpr std::size_t kFiles = 4;
constexpr const char* kSuffixes[kFiles] = {"", "-wal", ".mark", ".lock"};

// The bytes of a file, if it is there.
using Content = std::optional<std::string>;

// All files of a store at one moment, and how many poses `truck` had.
struct Moment {
  std::array<Content, kFiles> files;
  std::uint64_t poses = 0;
};

Content ReadIfThere(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  if (!in) return std::nullopt;
  std::stringstream all;
  all << in.rdbuf();
  return all.str();
}

class StoreAbsenceTest : public ::testing::Test {
 protected:
  // In memory, where the machine has such a directory: thousands are opened.
  StoreAbsenceTest()
      : directory_(std::filesystem::exists("/dev/shm")
                       ? "/dev/shm"
                       : std::filesystem::temp_directory_path()) {}

  static std::unique_ptr<Storage> MustOpen(const std::string& path) {
    absl::StatusOr<std::unique_ptr<Storage>> storage = OpenSqliteStorage(path);
    EXPECT_THAT(storage, IsOk());
    return *std::move(storage);
  }

  static Moment Now(const std::string& path, std::uint64_t poses) {
    Moment moment;
    for (std::size_t i = 0; i < kFiles; ++i) {
      moment.files[i] = ReadIfThere(path + kSuffixes[i]);
    }
    moment.poses = poses;
    return moment;
  }

  static void Append(Storage* storage, std::uint64_t first,
                     std::uint64_t last) {
    BlockingWrites write(storage);
    const VehicleKey key = storage->GetVehicle("truck")->key;
    for (std::uint64_t i = first; i <= last; ++i) {
      ASSERT_THAT(write.Append(key, {i, 1, i + 1, "pose"}), IsOk());
    }
  }

  // The life of a store: after an orderly end; twice in a second run; when its
  // log was copied; when that was begun anew; after its orderly end.
  std::vector<Moment> MakeMoments(const std::string& path) const {
    std::vector<Moment> moments;
    {
      const std::unique_ptr<Storage> storage = MustOpen(path);
      EXPECT_THAT(BlockingWrites(storage.get()).Create("truck"), IsOk());
      Append(storage.get(), 1, 3);
    }
    moments.push_back(Now(path, 3));
    {
      const std::unique_ptr<Storage> storage = MustOpen(path);
      Append(storage.get(), 4, 5);
      moments.push_back(Now(path, 5));
      Append(storage.get(), 6, 7);
      moments.push_back(Now(path, 7));
      {
        const auto other =
            *SqliteDatabase::Open(path, SqliteDatabase::Mode::kReadWrite, "");
        EXPECT_THAT(other->QueryInteger("PRAGMA schema_version"), IsOk());
        EXPECT_TRUE(*other->CopyLog());
      }
      moments.push_back(Now(path, 7));
      EXPECT_FALSE(moments[3].files[0] == moments[2].files[0]);
      Append(storage.get(), 8, 9);
      moments.push_back(Now(path, 9));
    }
    moments.push_back(Now(path, 9));
    EXPECT_FALSE(moments[5].files[1].has_value());
    return moments;
  }

  std::string Path() const { return directory_.File("tried.db"); }

  void Put(const std::array<Content, kFiles>& files) const {
    for (const std::string& file : FilesBeside(Path())) {
      std::filesystem::remove(file);
    }
    std::filesystem::remove(Path());
    for (std::size_t i = 0; i < kFiles; ++i) {
      if (!files[i]) continue;
      std::ofstream(Path() + kSuffixes[i], std::ios::binary) << *files[i];
    }
  }

  const TemporaryDirectory directory_;
};

TEST_F(StoreAbsenceTest, IsToldOrServedRightInEveryCombination) {
  const std::vector<Moment> life = MakeMoments(directory_.File("a.db"));
  const std::vector<Moment> others_life = MakeMoments(directory_.File("b.db"));
  const Moment& other = others_life[2];
  // The earliest moment at which a file was what it is: more it cannot prove.
  const auto proven = [](const std::vector<Moment>& of, std::size_t file,
                         const Content& content) {
    std::size_t moment = 0;
    while (of[moment].files[file] != content) ++moment;
    return moment;
  };
  struct Tried {
    std::size_t older;
    std::size_t now;
  };
  int served = 0;
  int refused = 0;
  for (const Tried& tried : {Tried{1, 2}, Tried{1, 4}, Tried{2, 4}, Tried{3, 4},
                             Tried{0, 2}, Tried{0, 5}, Tried{4, 5}}) {
    for (int combination = 0; combination < 625; ++combination) {
      std::array<Content, kFiles> files;
      std::string text = std::to_string(tried.older) + " and " +
                         std::to_string(tried.now) + ":";
      std::size_t newest = 0;
      bool has_other = false;
      bool has_ours = false;
      bool has_any = false;
      // Whether database and log are as they should be, and nothing beside them
      // speaks against it.
      bool is_whole = true;
      int rest = combination;
      for (std::size_t i = 0; i < kFiles; ++i) {
        static constexpr const char* kHow[] = {"there", "missing", "empty",
                                               "older", "other"};
        const int how = rest % 5;
        rest /= 5;
        const Content choices[] = {life[tried.now].files[i], std::nullopt, "",
                                   life[tried.older].files[i], other.files[i]};
        files[i] = choices[how];
        text += std::string(" ") + kSuffixes[i] + " " + kHow[how];
        has_any |= files[i].has_value();
        if (i < 2 && files[i] != life[tried.now].files[i]) is_whole = false;
        if (!files[i] || files[i]->empty()) continue;
        if (how == 4) {
          has_other = true;
          is_whole = false;
        } else {
          has_ours = true;
        }
        newest = std::max(newest,
                          proven(how == 4 ? others_life : life, i, files[i]));
      }
      SCOPED_TRACE(text);
      Put(files);
      // Read first, which must leave all as it is.
      const absl::StatusOr<StoreReport> checked =
          CheckStore(Path(), StoreUse::kIdle);
      const bool is_sound = checked.ok() && checked->problems.empty();
      for (std::size_t i = 0; i < kFiles; ++i) {
        ASSERT_TRUE(ReadIfThere(Path() + kSuffixes[i]) == files[i]);
      }
      const absl::StatusOr<std::unique_ptr<Storage>> storage =
          OpenSqliteStorage(Path());
      if (!storage.ok()) {
        ++refused;
        ASSERT_THAT(storage, IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                                     HasSubstr("tried.db")));
        EXPECT_FALSE(is_sound);
        EXPECT_FALSE(is_whole) << storage.status();
        EXPECT_TRUE(has_any);
        // As it was, for whoever repairs it.
        for (std::size_t i = 0; i < 3; ++i) {
          if (files[i]) {
            ASSERT_TRUE(ReadIfThere(Path() + kSuffixes[i]) == files[i]);
          }
        }
        continue;
      }
      ++served;
      EXPECT_EQ(is_sound, has_any) << checked.status();
      const absl::StatusOr<VehicleRecord> truck =
          (*storage)->GetVehicle("truck");
      if (!has_any) {
        EXPECT_EQ(truck.status().code(), StatusCode::kNotFound);
        continue;
      }
      ASSERT_THAT(truck, IsOk());
      EXPECT_FALSE(has_other && has_ours);
      EXPECT_EQ(truck->durable_sequence,
                (has_other ? others_life : life)[newest].poses);
      EXPECT_THAT(ReadAll(**storage, truck->key, 1, truck->durable_sequence),
                  IsOk());
      ASSERT_FALSE(HasFailure());
    }
  }
  RecordProperty("served", served);
  RecordProperty("refused", refused);
  EXPECT_GT(served, 100);
}

TEST_F(StoreAbsenceTest, SaysWhichFileIsMissingAndWhatIsThere) {
  const Moment now = MakeMoments(directory_.File("a.db"))[2];
  for (const Content& database : {Content(), Content("")}) {
    Moment harmed = now;
    harmed.files[0] = database;
    Put(harmed.files);
    const auto told =
        IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                AllOf(HasSubstr("tried.db is " +
                                std::string(database ? "empty" : "missing")),
                      HasSubstr("tried.db-wal and")));
    EXPECT_THAT(CheckStore(Path(), StoreUse::kIdle), told);
    EXPECT_THAT(CheckStore(Path(), StoreUse::kServed), told);
    EXPECT_THAT(
        BackUpStore(Path(), StoreUse::kIdle, directory_.File("copy.db")), told);
    EXPECT_THAT(OpenSqliteStorage(Path()), told);
    // Not even if what is damaged is to be dropped.
    SqliteOptions drop;
    drop.drop_damaged_log = true;
    EXPECT_THAT(OpenSqliteStorage(Path(), drop), told);
    EXPECT_TRUE(ReadIfThere(Path() + "-wal") == now.files[1]);
  }
}

TEST_F(StoreAbsenceTest, LogOfAnotherStoreIsAppliedInNoCase) {
  const Moment now = MakeMoments(directory_.File("a.db"))[2];
  const Moment other = MakeMoments(directory_.File("b.db"))[2];
  Moment mixed = now;
  mixed.files[1] = other.files[1];
  Put(mixed.files);
  SqliteOptions drop;
  drop.drop_damaged_log = true;
  const auto told = IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                            HasSubstr("is of another store than"));
  EXPECT_THAT(OpenSqliteStorage(Path(), drop), told);
  EXPECT_THAT(CheckStore(Path(), StoreUse::kIdle), told);
}

TEST_F(StoreAbsenceTest, LogThatIsMissingCanBeDropped) {
  Moment now = MakeMoments(directory_.File("a.db"))[4];
  now.files[1].reset();
  Put(now.files);
  EXPECT_THAT(OpenSqliteStorage(Path()),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                      HasSubstr("is missing, or the database is older")));
  SqliteOptions drop;
  drop.drop_damaged_log = true;
  for (const bool again : {false, true}) {
    const auto storage =
        OpenSqliteStorage(Path(), again ? SqliteOptions() : drop);
    ASSERT_THAT(storage, IsOk());
    EXPECT_EQ((*storage)->GetVehicle("truck")->durable_sequence, 7u);
  }
}

TEST_F(StoreAbsenceTest, StoreIsForItsOwnerAlone) {
  const std::string home = directory_.File("new/deep/store");
  ASSERT_THAT(MakeDirectory(home), IsOk());
  ASSERT_THAT(MakeDirectory(home + "/"), IsOk());
  const std::string path = home + "/revisit.sqlite";
  const std::unique_ptr<Storage> storage = MustOpen(path);
  EXPECT_THAT(BlockingWrites(storage.get()).Create("truck"), IsOk());
  const std::string copy = directory_.File("copy.db");
  EXPECT_THAT(BackUpStore(path, StoreUse::kServed, copy), IsOk());
  using std::filesystem::perms;
  const auto rights = [](const std::string& file) {
    return std::filesystem::status(file).permissions();
  };
  std::vector<std::string> files = FilesBeside(path);
  EXPECT_EQ(files.size(), 5u);
  files.push_back(path);
  files.push_back(copy);
  for (const std::string& file : files) {
    EXPECT_EQ(rights(file), perms::owner_read | perms::owner_write) << file;
  }
  for (const char* part : {"new", "new/deep", "new/deep/store"}) {
    EXPECT_EQ(rights(directory_.File(part)), perms::owner_all) << part;
  }
}

}  // namespace
}  // namespace revisit::server
