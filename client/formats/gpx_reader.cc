#include <expat.h>

#include <deque>
#include <string>
#include <string_view>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/formats/gnss_readers.h"
#include "client/formats/plain_readers.h"

namespace revisit::client {
namespace {

constexpr std::size_t kLongestText = 1000;

class GpxReader : public SampleReader {
 public:
  explicit GpxReader(std::unique_ptr<Lines> lines)
      : lines_(std::move(lines)),
        parser_(XML_ParserCreate(nullptr), XML_ParserFree) {
    XML_SetUserData(parser_.get(), this);
    XML_SetElementHandler(parser_.get(), OnStart, OnEnd);
    XML_SetCharacterDataHandler(parser_.get(), OnText);
    XML_SetEntityDeclHandler(parser_.get(), OnEntity);
  }

  absl::StatusOr<std::optional<Sample>> Next() override {
    while (points_.empty()) {
      if (!error_.ok()) return error_;
      if (ended_) return std::optional<Sample>();
      const std::string_view chunk = lines_->NextChunk();
      if (!lines_->status().ok()) return lines_->status();
      ended_ = chunk.empty();
      const XML_Status status =
          XML_Parse(parser_.get(), chunk.data(), static_cast<int>(chunk.size()),
                    ended_ ? 1 : 0);
      if (status != XML_STATUS_OK && error_.ok()) {
        error_ = Error(XML_ErrorString(XML_GetErrorCode(parser_.get())));
      }
    }
    Sample sample = points_.front();
    points_.pop_front();
    return sample;
  }

 private:
  static GpxReader* This(void* data) { return static_cast<GpxReader*>(data); }

  // Without the prefix of a name space.
  static std::string_view LocalName(const char* name) {
    const std::string_view whole = name;
    return whole.substr(whole.rfind(':') + 1);
  }

  static void OnStart(void* data, const char* name, const char** attributes) {
    This(data)->Start(LocalName(name), attributes);
  }
  static void OnEnd(void* data, const char* name) {
    This(data)->End(LocalName(name));
  }
  static void OnText(void* data, const char* text, int length) {
    This(data)->Text(std::string_view(text, static_cast<std::size_t>(length)));
  }
  // GPX has no use for entities, and bombs are made of them.
  static void OnEntity(void* data, const char*, int, const char*, int,
                       const char*, const char*, const char*, const char*) {
    This(data)->Fail(This(data)->Error("entities are not allowed in GPX"));
  }

  std::int64_t LineNumber() const {
// Debian 13's expat has it in 64 bits too, and warns of the other.
#if XML_MAJOR_VERSION > 2 || XML_MINOR_VERSION >= 9
    return static_cast<std::int64_t>(XML_GetCurrentLineNumber64(parser_.get()));
#else
    return static_cast<std::int64_t>(XML_GetCurrentLineNumber(parser_.get()));
#endif
  }

  absl::Status Error(const std::string& message) const {
    return absl::InvalidArgumentError(
        absl::StrCat(lines_->path(), ":", LineNumber(), ": ", message));
  }

  void Fail(const absl::Status& error) {
    if (!error_.ok()) return;
    error_ = error;
    XML_StopParser(parser_.get(), XML_FALSE);
  }

  // Readers of fields name the line of a Lines; here the parser knows it.
  template <typename T>
  std::optional<T> Value(const absl::StatusOr<T>& value) {
    if (value.ok()) return *value;
    const std::string message(value.status().message());
    const std::string place = absl::StrCat(lines_->path(), ":0: ");
    Fail(Error(message.substr(
        message.compare(0, place.size(), place) == 0 ? place.size() : 0)));
    return std::nullopt;
  }

  void Start(std::string_view name, const char** attributes) {
    if (depth_++ == 0 && name != "gpx") {
      Fail(Error("expected the element gpx, got " + Quoted(name)));
      return;
    }
    text_.clear();
    if (name != "trkpt") return;
    point_.emplace();
    point_depth_ = depth_;
    std::optional<double> latitude;
    std::optional<double> longitude;
    for (; *attributes != nullptr; attributes += 2) {
      const std::string_view attribute = attributes[0];
      if (attribute == "lat") {
        latitude = Value(ReadNumber(attributes[1], "lat", *lines_));
      } else if (attribute == "lon") {
        longitude = Value(ReadNumber(attributes[1], "lon", *lines_));
      }
    }
    if (!latitude.has_value() || !longitude.has_value()) {
      Fail(Error("expected lat and lon of a trkpt"));
      return;
    }
    point_->geodetic = {*latitude, *longitude, 0.0};
    point_->has_heading = false;
    point_->line = LineNumber();
    Value(AsValue(CheckPose(*point_, *lines_)));
  }

  static absl::StatusOr<bool> AsValue(const absl::Status& status) {
    if (!status.ok()) return status;
    return true;
  }

  void Text(std::string_view text) {
    if (!point_.has_value()) return;
    if (text_.size() + text.size() > kLongestText) {
      // Nothing that is read is as long.
      text_.resize(kLongestText);
      return;
    }
    text_.append(text);
  }

  void End(std::string_view name) {
    // Only what stands in the point itself, not in its extensions.
    if (point_.has_value() && depth_ == point_depth_ + 1) {
      std::string_view text = text_;
      const std::size_t first = text.find_first_not_of(" \t\r\n");
      text = first == text.npos
                 ? std::string_view()
                 : text.substr(first,
                               text.find_last_not_of(" \t\r\n") - first + 1);
      if (name == "ele") {
        point_->geodetic->height_meters =
            Value(ReadNumber(text, "ele", *lines_)).value_or(0.0);
      } else if (name == "time") {
        point_->time_nanoseconds =
            Value(ReadTime(text, TimeUnit::kByMagnitude, *lines_));
      }
    }
    if (point_.has_value() && depth_ == point_depth_) {
      points_.push_back(*std::exchange(point_, std::nullopt));
    }
    --depth_;
  }

  const std::unique_ptr<Lines> lines_;
  const std::unique_ptr<XML_ParserStruct, decltype(&XML_ParserFree)> parser_;
  // Points of the chunk that was parsed last.
  std::deque<Sample> points_;
  std::optional<Sample> point_;
  std::string text_;
  int depth_ = 0;
  int point_depth_ = 0;
  bool ended_ = false;
  absl::Status error_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<SampleReader>> ReadGpx(
    std::unique_ptr<Lines> lines, const ReaderOptions& /*options*/) {
  return std::make_unique<GpxReader>(std::move(lines));
}

}  // namespace revisit::client
