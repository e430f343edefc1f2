#include "server/storage/sqlite/write_ahead_log.h"

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstddef>
#include <cstdio>
#include <memory>
#include <optional>

#include "absl/strings/str_cat.h"
#include "server/base/status.h"

namespace revisit::server {
namespace {

constexpr std::size_t kLogHeaderBytes = 32;
constexpr std::size_t kFrameHeaderBytes = 24;
// Smallest unit that a device writes whole or not at all.
constexpr std::uint64_t kSectorBytes = 512;
// First word of a log. Its last bit says in which byte order the checksums were
// summed.
constexpr std::uint32_t kLogMagic = 0x377f0682;
constexpr std::uint32_t kFormat = 3007000;

constexpr unsigned char kTableLeaf = 0x0d;
constexpr unsigned char kIndexLeaf = 0x0a;
constexpr unsigned char kIndexInterior = 0x02;

std::uint32_t BigEndian(const unsigned char* bytes) {
  return std::uint32_t{bytes[0]} << 24 | std::uint32_t{bytes[1]} << 16 |
         std::uint32_t{bytes[2]} << 8 | std::uint32_t{bytes[3]};
}

std::uint32_t LittleEndian(const unsigned char* bytes) {
  return std::uint32_t{bytes[3]} << 24 | std::uint32_t{bytes[2]} << 16 |
         std::uint32_t{bytes[1]} << 8 | std::uint32_t{bytes[0]};
}

struct Checksum {
  std::uint32_t a = 0;
  std::uint32_t b = 0;

  static Checksum Stored(const unsigned char* bytes) {
    return {BigEndian(bytes), BigEndian(bytes + 4)};
  }

  // REQUIRES: `size` is a multiple of 8.
  void Add(const unsigned char* bytes, std::size_t size, bool big_endian) {
    for (std::size_t i = 0; i < size; i += 8) {
      a += (big_endian ? BigEndian(bytes + i) : LittleEndian(bytes + i)) + b;
      b += (big_endian ? BigEndian(bytes + i + 4)
                       : LittleEndian(bytes + i + 4)) +
           a;
    }
  }
};

bool operator==(const Checksum& x, const Checksum& y) {
  return x.a == y.a && x.b == y.b;
}

struct CloseFile {
  void operator()(std::FILE* file) const { std::fclose(file); }
};
using File = std::unique_ptr<std::FILE, CloseFile>;

absl::Status Unreadable(const std::string& path) {
  return Error(absl::StatusCode::kUnavailable, "STORE_UNAVAILABLE",
               "cannot read the log " + path + ": " +
                   absl::ErrnoToStatus(errno, "").ToString());
}

struct Frame {
  std::vector<unsigned char> bytes;  // Header and page.

  std::uint32_t page_number() const { return BigEndian(bytes.data()); }
  const unsigned char* page() const { return bytes.data() + kFrameHeaderBytes; }
  std::size_t page_bytes() const { return bytes.size() - kFrameHeaderBytes; }
  bool is_commit() const { return BigEndian(bytes.data() + 4) != 0; }
  bool has_salts(const LogPosition& of) const {
    return BigEndian(bytes.data() + 8) == of.salt1 &&
           BigEndian(bytes.data() + 12) == of.salt2;
  }
  Checksum stored() const { return Checksum::Stored(bytes.data() + 16); }
  Checksum Computed(Checksum seed, bool big_endian) const {
    seed.Add(bytes.data(), 8, big_endian);
    seed.Add(page(), page_bytes(), big_endian);
    return seed;
  }
};

// Whether the word that says if a frame ends a commit lies in another sector
// than its salts: then the word may be that of an older use although the salts
// are new.
bool MayBeTorn(std::uint32_t number, std::size_t frame_bytes) {
  const std::uint64_t at =
      kLogHeaderBytes + std::uint64_t{number - 1} * frame_bytes;
  return at / kSectorBytes != (at + 8) / kSectorBytes;
}

// Reads the next frame; false at the end of the whole frames.
absl::StatusOr<bool> ReadFrame(std::FILE* file, const std::string& path,
                               Frame* frame) {
  const std::size_t read =
      std::fread(frame->bytes.data(), 1, frame->bytes.size(), file);
  if (read == frame->bytes.size()) return true;
  if (std::ferror(file) != 0) return Unreadable(path);
  return false;
}

// Reads a varint of 1 to 9 bytes; nullopt if it does not end before `end`.
std::optional<std::uint64_t> Varint(const unsigned char** at,
                                    const unsigned char* end) {
  std::uint64_t value = 0;
  for (int i = 0; i < 9 && *at < end; ++i) {
    const unsigned char byte = *(*at)++;
    if (i == 8) return value << 8 | byte;
    value = value << 7 | (byte & 0x7f);
    if ((byte & 0x80) == 0) return value;
  }
  return std::nullopt;
}

// A column: its type as SQLite has it, and its bytes if they lie in the page.
struct Column {
  std::uint64_t type;
  const unsigned char* bytes;

  bool is_null() const { return type == 0; }
  bool is_integer() const {
    return (type >= 1 && type <= 6) || type == 8 || type == 9;
  }
  bool is_blob() const { return type >= 12 && type % 2 == 0; }
  bool is_text() const { return type >= 13 && type % 2 == 1; }
  std::size_t size() const {
    constexpr std::array<std::size_t, 12> kSizes = {0, 1, 2, 3, 4, 6,
                                                    8, 8, 0, 0, 0, 0};
    return type < 12 ? kSizes[type] : static_cast<std::size_t>((type - 12) / 2);
  }
  std::int64_t integer() const {
    if (type == 8 || type == 9) return static_cast<std::int64_t>(type - 8);
    // The first byte holds the sign.
    std::uint64_t value =
        (bytes[0] & 0x80) != 0 ? ~std::uint64_t{0} : std::uint64_t{0};
    for (std::size_t i = 0; i < size(); ++i) value = value << 8 | bytes[i];
    return static_cast<std::int64_t>(value);
  }
  std::string text() const {
    return std::string(reinterpret_cast<const char*>(bytes), size());
  }
};

// The columns of a record up to and including the first that does not lie whole
// in the page, which comes without its bytes.
std::vector<Column> Columns(const unsigned char* at, const unsigned char* end) {
  std::vector<Column> columns;
  const unsigned char* const start = at;
  const std::optional<std::uint64_t> header = Varint(&at, end);
  if (!header || *header > static_cast<std::uint64_t>(end - start)) return {};
  const unsigned char* const header_end = start + *header;
  const unsigned char* body = header_end;
  bool in_page = true;
  while (at < header_end) {
    const std::optional<std::uint64_t> type = Varint(&at, header_end);
    if (!type) return {};
    Column column{*type, nullptr};
    if (in_page && column.size() <= static_cast<std::size_t>(end - body)) {
      column.bytes = body;
      body += column.size();
    } else {
      in_page = false;
    }
    columns.push_back(column);
  }
  return columns;
}

std::optional<LoggedRow> RowOf(const std::vector<Column>& columns) {
  const auto are_integers = [&](std::size_t first, std::size_t last) {
    for (std::size_t i = first; i <= last; ++i) {
      if (!columns[i].is_integer() || columns[i].bytes == nullptr) return false;
    }
    return true;
  };
  LoggedRow row;
  if (columns.size() == 7 && columns[6].is_blob() && are_integers(0, 5)) {
    row.table = LoggedRow::Table::kBatches;
    row.vehicle_key = columns[0].integer();
    row.first_sequence = columns[1].integer();
    row.checksum = columns[5].integer();
    return row;
  }
  if (columns.size() == 6 && columns[0].is_null() && columns[1].is_text() &&
      columns[1].bytes != nullptr && are_integers(2, 4) &&
      columns[5].is_blob()) {
    row.table = LoggedRow::Table::kVehicles;
    row.id = columns[1].text();
    row.checksum = columns[4].integer();
    return row;
  }
  if (columns.size() == 8 && columns[7].is_blob() && are_integers(0, 0) &&
      columns[1].is_text() && columns[1].bytes != nullptr &&
      are_integers(2, 6)) {
    row.table = LoggedRow::Table::kPairs;
    row.vehicle_key = columns[0].integer();
    row.id = columns[1].text();
    row.checksum = columns[6].integer();
    return row;
  }
  return std::nullopt;
}

// The cells of a page of a table or an index, as far as they make sense.
void VisitRows(const unsigned char* page, std::size_t size,
               const std::function<void(const LoggedRow&)>& visit) {
  const unsigned char type = page[0];
  if (type != kTableLeaf && type != kIndexLeaf && type != kIndexInterior) {
    return;
  }
  const unsigned char* const end = page + size;
  const std::size_t pointers = type == kIndexInterior ? 12 : 8;
  const std::size_t cells = std::size_t{page[3]} << 8 | page[4];
  for (std::size_t i = 0; i < cells && pointers + 2 * i + 2 <= size; ++i) {
    const unsigned char* const pointer = page + pointers + 2 * i;
    const std::size_t offset = std::size_t{pointer[0]} << 8 | pointer[1];
    if (offset < pointers || offset + 4 > size) continue;
    const unsigned char* at = page + offset;
    if (type == kIndexInterior) at += 4;  // The child.
    if (!Varint(&at, end)) continue;      // The size of the record.
    if (type == kTableLeaf && !Varint(&at, end)) continue;
    const std::optional<LoggedRow> row = RowOf(Columns(at, end));
    if (row) visit(*row);
  }
}

using LogHeader = std::array<unsigned char, kLogHeaderBytes>;

// Whether the log's checksums were summed over big-endian words.
bool IsBigEndian(const LogHeader& header) {
  return (BigEndian(header.data()) & 1) != 0;
}

// Reads the header of a log into the report. Returns its checksum, with which
// those of the frames begin.
Checksum ReadHeader(const LogHeader& header, LogReport* report) {
  const std::uint32_t magic = BigEndian(header.data());
  Checksum checksum;
  checksum.Add(header.data(), kFrameHeaderBytes, IsBigEndian(header));
  report->page_bytes = BigEndian(header.data() + 8);
  // SQLite's page sizes are powers of two from 512 to 65536.
  const bool page_size_is_sane =
      report->page_bytes >= 512 && report->page_bytes <= 65536 &&
      (report->page_bytes & (report->page_bytes - 1)) == 0;
  report->has_header = (magic & ~1u) == kLogMagic && page_size_is_sane &&
                       BigEndian(header.data() + 4) == kFormat &&
                       checksum == Checksum::Stored(header.data() + 24);
  if (report->has_header) {
    report->end = {BigEndian(header.data() + 16), BigEndian(header.data() + 20),
                   0};
  }
  return checksum;
}

// Follows the frames of a log, and finds where the commits end that SQLite
// would read, and what lies behind them.
class FrameReader {
 public:
  // `header` is the checksum of the header.
  FrameReader(const Checksum& header, bool big_endian, LogReport* report)
      : big_endian_(big_endian), report_(report), stored_(header) {}

  void Read(const Frame& frame) {
    const std::uint32_t number = ++report_->frames_in_file;
    const Checksum continued = frame.Computed(stored_, big_endian_);
    const bool has_salts = frame.has_salts(report_->end);
    const bool fits =
        has_salts && (continued == frame.stored() ||
                      (computed_ && frame.Computed(*computed_, big_endian_) ==
                                        frame.stored()));
    computed_.reset();
    if (first_bad_ == 0 && fits) {
      ReadSound(frame, number);
    } else if (first_bad_ == 0) {
      first_bad_ = number;
      computed_ = continued;
      report_->has_unfinished_tail |= has_salts;
    } else if (fits) {
      report_->has_unfinished_tail = true;
      if (after_commit_) {
        report_->damage = absl::StrCat(
            "frame ", first_bad_, " fails its checksum, and frame ", number,
            " behind it belongs to a later commit");
      }
    }
    stored_ = frame.stored();
    after_commit_ =
        frame.is_commit() && (fits || ((has_salts || number == first_bad_) &&
                                       !MayBeTorn(number, frame.bytes.size())));
  }

  // Call after the last frame.
  void Finish() {
    if (first_bad_ == 0 && report_->frames_in_file > report_->end.frames) {
      report_->has_unfinished_tail = true;
    }
  }

 private:
  void ReadSound(const Frame& frame, std::uint32_t number) {
    if (const auto found = StateInPage(frame.page(), frame.page_bytes())) {
      state_ = found;
    }
    if (!frame.is_commit()) return;
    report_->end.frames = number;
    if (state_) report_->states.push_back(*state_);
    state_.reset();
  }

  const bool big_endian_;
  LogReport* const report_;
  // Checksums of the frame before: the stored one, and the right one.
  Checksum stored_;
  std::optional<Checksum> computed_;
  // Whether the frame before ended a commit, as far as that can be known.
  bool after_commit_ = false;
  // Number of the first frame that does not fit; 0 as long as all do.
  std::uint32_t first_bad_ = 0;
  // State in the commit that is being read.
  std::optional<StoreState> state_;
};

}  // namespace

absl::StatusOr<LogReport> ReadLog(const std::string& path) {
  LogReport report;
  const File file(std::fopen(path.c_str(), "rb"));
  if (file == nullptr) {
    if (errno == ENOENT) return report;
    return Unreadable(path);
  }
  LogHeader header;
  if (std::fread(header.data(), 1, header.size(), file.get()) !=
      header.size()) {
    if (std::ferror(file.get()) != 0) return Unreadable(path);
    return report;
  }
  const Checksum checksum = ReadHeader(header, &report);
  if (!report.has_header) {
    const bool is_blank =
        std::all_of(header.begin(), header.end(),
                    [](unsigned char byte) { return byte == 0; });
    // The header is flushed before anything is written behind it.
    if (!is_blank && std::fgetc(file.get()) != EOF) {
      report.damage = "its header fails its checksum";
    }
    return report;
  }
  FrameReader reader(checksum, IsBigEndian(header), &report);
  Frame frame;
  frame.bytes.resize(kFrameHeaderBytes + report.page_bytes);
  while (true) {
    const absl::StatusOr<bool> whole = ReadFrame(file.get(), path, &frame);
    if (!whole.ok()) return whole.status();
    if (!*whole) break;
    reader.Read(frame);
  }
  reader.Finish();
  return report;
}

absl::StatusOr<std::set<std::uint32_t>> PagesIn(const std::string& path,
                                                const LogReport& log) {
  std::set<std::uint32_t> pages;
  if (log.end.frames == 0) return pages;
  const File file(std::fopen(path.c_str(), "rb"));
  if (file == nullptr) return Unreadable(path);
  if (fseeko(file.get(), kLogHeaderBytes, SEEK_SET) != 0) {
    return Unreadable(path);
  }
  Frame frame;
  frame.bytes.resize(kFrameHeaderBytes + log.page_bytes);
  for (std::uint32_t i = 0; i < log.end.frames; ++i) {
    const absl::StatusOr<bool> whole = ReadFrame(file.get(), path, &frame);
    if (!whole.ok()) return whole.status();
    if (!*whole) break;
    pages.insert(frame.page_number());
  }
  return pages;
}

absl::Status VisitRowsBehind(
    const std::string& path, const LogReport& log,
    const std::function<void(const LoggedRow&)>& visit) {
  if (!log.has_header) return absl::OkStatus();
  const File file(std::fopen(path.c_str(), "rb"));
  if (file == nullptr) return Unreadable(path);
  Frame frame;
  frame.bytes.resize(kFrameHeaderBytes + log.page_bytes);
  const auto start = static_cast<std::int64_t>(
      kLogHeaderBytes + std::uint64_t{log.end.frames} * frame.bytes.size());
  if (fseeko(file.get(), start, SEEK_SET) != 0) return Unreadable(path);
  bool is_first = true;
  while (true) {
    const absl::StatusOr<bool> whole = ReadFrame(file.get(), path, &frame);
    if (!whole.ok()) return whole.status();
    if (!*whole) return absl::OkStatus();
    // The damaged frame may have lost its salts.
    if (is_first || frame.has_salts(log.end)) {
      VisitRows(frame.page(), frame.page_bytes(), visit);
    }
    is_first = false;
  }
}

}  // namespace revisit::server
