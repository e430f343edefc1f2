#include "server/security/strict_json.h"

#include <cstddef>
#include <nlohmann/json.hpp>
#include <utility>
#include <vector>

namespace revisit::server {
namespace {

using Json = nlohmann::json;

constexpr std::size_t kMaxDepth = 16;

// Builds the value as the library's own reader does, with stricter checks.
class Reader final : public nlohmann::json_sax<Json> {
 public:
  explicit Reader(Json* root) : root_(root) {}

  const std::string& problem() const { return problem_; }

  bool null() override { return Add(nullptr); }
  bool boolean(bool value) override { return Add(value); }
  bool number_integer(number_integer_t value) override { return Add(value); }
  bool number_unsigned(number_unsigned_t value) override { return Add(value); }
  bool number_float(number_float_t value, const string_t&) override {
    return Add(value);
  }
  bool string(string_t& value) override { return Add(std::move(value)); }
  bool binary(binary_t&) override { return false; }

  bool start_object(std::size_t) override { return Open(Json::object()); }
  bool end_object() override { return Close(); }
  bool start_array(std::size_t) override { return Open(Json::array()); }
  bool end_array() override { return Close(); }

  bool key(string_t& value) override {
    if (open_.back()->contains(value)) {
      problem_ = "the key \"" + value + "\" stands twice in one object";
      return false;
    }
    key_ = std::move(value);
    return true;
  }

  bool parse_error(std::size_t, const std::string&,
                   const nlohmann::detail::exception& error) override {
    problem_ = error.what();
    // Skips the library's own number of the error, which comes first.
    const std::size_t end = problem_.find("] ");
    if (problem_.rfind("[json", 0) == 0 && end != std::string::npos) {
      problem_ = problem_.substr(end + 2);
    }
    return false;
  }

 private:
  bool Add(Json value) {
    Place(std::move(value));
    return true;
  }

  // Pointers to open values hold: a value gets no more members while one of its
  // members is open.
  Json* Place(Json value) {
    if (open_.empty()) {
      *root_ = std::move(value);
      return root_;
    }
    Json* const parent = open_.back();
    if (parent->is_array()) {
      parent->push_back(std::move(value));
      return &parent->back();
    }
    Json& member = (*parent)[key_];
    member = std::move(value);
    return &member;
  }

  bool Open(Json value) {
    if (open_.size() == kMaxDepth) {
      problem_ = "nested deeper than " + std::to_string(kMaxDepth);
      return false;
    }
    open_.push_back(Place(std::move(value)));
    return true;
  }

  bool Close() {
    open_.pop_back();
    return true;
  }

  Json* const root_;
  std::vector<Json*> open_;
  std::string key_;
  std::string problem_;
};

}  // namespace

absl::Status ParseStrictJson(const std::string& text, nlohmann::json* value) {
  Reader reader(value);
  if (Json::sax_parse(text, &reader)) return absl::OkStatus();
  return absl::InvalidArgumentError(reader.problem().c_str());
}

}  // namespace revisit::server
