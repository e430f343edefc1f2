#include "server/conversion/vehicle_labels.h"

#include <map>
#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/records/proto_record_codec.h"
#include "tests/server/conversion/conversion_testing.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using ::testing::ElementsAre;
using ::testing::Pair;

constexpr FieldPath kVehicle;

TEST(VehicleLabelsTest, MaskTakesNamesAndKeysWithDots) {
  LabelsMask mask;
  for (const char* const path :
       {"display_name", "labels.a", "labels.session.night.2"}) {
    EXPECT_TRUE(mask.Take(path)) << path;
  }
  EXPECT_TRUE(mask.display_name);
  EXPECT_FALSE(mask.all_labels);
  EXPECT_THAT(mask.keys, ElementsAre("a", "session.night.2"));
  EXPECT_TRUE(mask.Take("labels"));
  EXPECT_TRUE(mask.all_labels);
  for (const char* const path : {"", "labels.", "label", "labelsa", "name",
                                 "display_name.a", "settings.labels"}) {
    EXPECT_FALSE(mask.Take(path)) << path;
  }
}

TEST(VehicleLabelsTest, UpdatesWhatIsNamedAndNothingElse) {
  VehicleConfig config;
  config.display_name = "before";
  config.labels = {{"a", "1"}, {"b", "2"}};
  v1::Vehicle vehicle;
  vehicle.set_display_name("after");
  (*vehicle.mutable_labels())["a"] = "3";
  (*vehicle.mutable_labels())["c"] = "4";
  LabelsMask mask;
  mask.keys = {"a", "b"};
  ASSERT_THAT(UpdateLabels(vehicle, mask, kVehicle, &config), IsOk());
  EXPECT_EQ(config.display_name, "before");
  EXPECT_THAT(config.labels, ElementsAre(Pair("a", "3")));
  ASSERT_THAT(UpdateLabels(vehicle, {true, true, {}}, kVehicle, &config),
              IsOk());
  EXPECT_EQ(config.display_name, "after");
  EXPECT_THAT(config.labels, ElementsAre(Pair("a", "3"), Pair("c", "4")));
}

TEST(VehicleLabelsTest, NamesEverythingThatIsWrong) {
  v1::Vehicle vehicle;
  vehicle.set_display_name(std::string(kMaxDisplayNameBytes + 1, 'a'));
  (*vehicle.mutable_labels())["a"] = std::string(kMaxLabelValueBytes + 1, 'a');
  (*vehicle.mutable_labels())["B"] = "";
  VehicleConfig config;
  const absl::Status status =
      UpdateLabels(vehicle, {true, true, {}}, kVehicle, &config);
  EXPECT_THAT(FieldsOf(status), ::testing::UnorderedElementsAre(
                                    "display_name", "labels.a", "labels"));
}

TEST(VehicleLabelsTest, AreStoredWithTheVehicle) {
  VehicleConfig config;
  config.display_name = "Truck 7";
  config.labels = {{"session.a", "1-2068"}, {"fleet", "north"}};
  config.create_time_ns = 1;
  const ProtoRecordCodec codec;
  const auto read = codec.DecodeVehicle(RecordOf(codec.EncodeVehicle(config)));
  ASSERT_THAT(read, IsOk());
  EXPECT_EQ(read->display_name, config.display_name);
  EXPECT_EQ(read->labels, config.labels);
}

TEST(VehicleLabelsTest, WhatIsRefusedTodayIsStillReadAndChangedAround) {
  VehicleConfig config;
  config.display_name = "\x1b[2J\u202e";
  config.labels = {{"a", "\u200b"}, {"b", "2"}};
  config.create_time_ns = 1;
  const ProtoRecordCodec codec;
  auto read = codec.DecodeVehicle(RecordOf(codec.EncodeVehicle(config)));
  ASSERT_THAT(read, IsOk());
  EXPECT_EQ(read->display_name, config.display_name);
  EXPECT_EQ(read->labels, config.labels);
  v1::Vehicle vehicle;
  (*vehicle.mutable_labels())["b"] = "3";
  LabelsMask mask;
  mask.keys = {"b"};
  ASSERT_THAT(UpdateLabels(vehicle, mask, kVehicle, &*read), IsOk());
  EXPECT_THAT(read->labels, ElementsAre(Pair("a", "\u200b"), Pair("b", "3")));
}

TEST(VehicleLabelsTest, NamesThatControlTurnAroundOrHideTextAreRefused) {
  for (const char* const text :
       {"\x01", "\x1f", "\x7f", "\u0080", "\u009f", "\n", "\t", "\u061c",
        "\u200b", "\u200e", "\u200f", "\u2028", "\u202e", "\u2060", "\u2066",
        "\u206f", "\ufeff", "a\u202e", "\U0001f697\u200b"}) {
    v1::Vehicle vehicle;
    vehicle.set_display_name(text);
    (*vehicle.mutable_labels())["a"] = text;
    VehicleConfig config;
    EXPECT_THAT(
        FieldsOf(UpdateLabels(vehicle, {true, true, {}}, kVehicle, &config)),
        ::testing::UnorderedElementsAre("display_name", "labels.a"))
        << text;
  }
}

TEST(VehicleLabelsTest, NamesOfAnyScriptAreTaken) {
  for (const char* const text :
       {"", " ", "~", "\u00a0", "\u00ad", "\u0627\u200c\u0628", "\u200d",
        "\u2027", "\u202f", "\u205f", "\u2070", "\ufe0f", "\u3000", "\uffff",
        "\U00010000", "\U0001f469\u200d\U0001f527", "\U000e0067",
        "\U0010ffff"}) {
    v1::Vehicle vehicle;
    vehicle.set_display_name(text);
    VehicleConfig config;
    EXPECT_THAT(UpdateLabels(vehicle, {true, true, {}}, kVehicle, &config),
                IsOk())
        << text;
  }
}

TEST(VehicleLabelsTest, AnswerIsTrimmedToTheKeysThatWereNamed) {
  v1::Vehicle vehicle;
  vehicle.set_name("vehicles/a");
  vehicle.set_display_name("A");
  vehicle.mutable_settings()->set_max_candidates(3);
  (*vehicle.mutable_labels())["a"] = "1";
  (*vehicle.mutable_labels())["b.c"] = "2";
  google::protobuf::FieldMask mask;
  mask.add_paths("labels.b.c");
  mask.add_paths("settings.max_candidates");
  v1::Vehicle trimmed = vehicle;
  TrimToMask(mask, &trimmed);
  EXPECT_EQ(trimmed.name(), "");
  EXPECT_EQ(trimmed.display_name(), "");
  EXPECT_EQ(trimmed.settings().max_candidates(), 3);
  EXPECT_EQ(trimmed.labels_size(), 1);
  EXPECT_EQ(trimmed.labels().at("b.c"), "2");
  mask.Clear();
  mask.add_paths("settings");
  trimmed = vehicle;
  TrimToMask(mask, &trimmed);
  EXPECT_EQ(trimmed.labels_size(), 0);
}

}  // namespace
}  // namespace revisit::server
