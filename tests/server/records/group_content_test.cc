#include "server/records/group_content.h"

#include <limits>
#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/loop_closure.pb.h"
#include "tests/server/conversion/conversion_testing.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using ::testing::_;
using ::testing::ElementsAre;

constexpr char kDatum[] = R"pb(
  datum_id: "site"
  pose { x_meters: 10 y_meters: -20 z_meters: 1 heading_radians: 0.5 }
  covariance {
    form: COVARIANCE_FORM_PLANAR_6
    values: [ 1, 0, 0, 1, 0, 0.01 ]
  }
)pb";

auto IsDamage() {
  return IsError(absl::StatusCode::kDataLoss, "STORE_CORRUPT", _);
}

std::string MemberWith(const v1::Datum& datum) {
  const RecordingStartFields fields = DatumFieldsOf(datum);
  return EncodeMemberContent(&fields);
}

LinkContent LinkNoted(const std::string& note, const std::string& by,
                      std::int64_t create_time_ns) {
  LinkContent link;
  link.content.note = note;
  link.content.decided_by = by;
  link.create_time_ns = create_time_ns;
  return link;
}

TEST(GroupContentTest, IsReadAsItWasWritten) {
  GroupContent content;
  content.display_name = "Night shift";
  content.settings.geodetic_origin = GeodeticOrigin{-33.5, 151.25, 7.0};
  content.settings.fix_bias_meters = 1.5;
  content.create_time_ns = -1234567890123456789;
  const auto read = DecodeGroupContent(EncodeGroupContent(content));
  ASSERT_THAT(read, IsOk());
  EXPECT_EQ(read->display_name, "Night shift");
  EXPECT_EQ(read->settings, content.settings);
  EXPECT_EQ(read->create_time_ns, content.create_time_ns);
}

TEST(GroupContentTest, HasDefaultsWhereNothingWasSet) {
  const auto read = DecodeGroupContent(EncodeGroupContent({}));
  ASSERT_THAT(read, IsOk());
  EXPECT_EQ(read->settings, GroupSettings());
  EXPECT_FALSE(read->settings.geodetic_origin.has_value());
}

TEST(GroupContentTest, BytesThatAreNoGroupAreDamage) {
  EXPECT_THAT(DecodeGroupContent("\xff"), IsDamage());
  // A group has a time of creation.
  EXPECT_THAT(DecodeGroupContent(""), IsDamage());
  GroupContent content;
  content.settings.fix_bias_meters = -1.0;
  EXPECT_THAT(DecodeGroupContent(EncodeGroupContent(content)), IsDamage());
  content.settings.fix_bias_meters = 0.0;
  content.settings.geodetic_origin =
      GeodeticOrigin{std::numeric_limits<double>::quiet_NaN(), 0.0, 0.0};
  EXPECT_THAT(DecodeGroupContent(EncodeGroupContent(content)), IsDamage());
}

TEST(MemberContentTest, IsReadAsItWasWritten) {
  v1::Datum read;
  ASSERT_THAT(ReadMemberContent(MemberWith(FromText<v1::Datum>(kDatum)),
                                [&](const RecordingStartFields* datum) {
                                  ASSERT_NE(datum, nullptr);
                                  SetDatum(*datum, &read);
                                }),
              IsOk());
  EXPECT_EQ(read.SerializeAsString(),
            FromText<v1::Datum>(kDatum).SerializeAsString());
}

TEST(MemberContentTest, WithoutADatumIsEmpty) {
  EXPECT_EQ(EncodeMemberContent(nullptr), "");
  bool called = false;
  ASSERT_THAT(ReadMemberContent("",
                                [&](const RecordingStartFields* datum) {
                                  EXPECT_EQ(datum, nullptr);
                                  called = true;
                                }),
              IsOk());
  EXPECT_TRUE(called);
  const auto start = DecodeMemberDatum("", core::StateSpace::kPlanar);
  ASSERT_THAT(start, IsOk());
  EXPECT_EQ(*start, nullptr);
}

TEST(MemberContentTest, DatumIsThatOfCore) {
  const auto start = DecodeMemberDatum(MemberWith(FromText<v1::Datum>(kDatum)),
                                       core::StateSpace::kPlanar);
  ASSERT_THAT(start, IsOk());
  ASSERT_NE(*start, nullptr);
  EXPECT_EQ((*start)->relation, core::RecordingRelation::kDatum);
  EXPECT_EQ((*start)->datum_id, "site");
  EXPECT_EQ((*start)->datum.x, 10.0);
  EXPECT_EQ((*start)->datum.heading, 0.5);
  EXPECT_EQ((*start)->covariance(3, 3), 0.01);
  EXPECT_EQ((*start)->label, "");
}

TEST(MemberContentTest, DatumHasToFitTheStateSpace) {
  const auto start = DecodeMemberDatum(MemberWith(FromText<v1::Datum>(kDatum)),
                                       core::StateSpace::kSpatial);
  EXPECT_EQ(start.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(FieldsOf(start.status()),
              ElementsAre("member.datum.covariance.form"));
}

TEST(MemberContentTest, TextsThatAreStoredAreNotJudgedAgain) {
  auto datum = FromText<v1::Datum>(kDatum);
  datum.set_datum_id("line\nfeed");
  EXPECT_THAT(DecodeMemberDatum(MemberWith(datum), core::StateSpace::kPlanar),
              IsOk());
}

TEST(MemberContentTest, BytesThatAreNoMemberAreDamage) {
  EXPECT_THAT(ReadMemberContent(
                  "\xff", [](const RecordingStartFields*) { ADD_FAILURE(); }),
              IsDamage());
  EXPECT_THAT(DecodeMemberDatum("\xff", core::StateSpace::kPlanar), IsDamage());
}

TEST(LinkContentTest, IsReadAsItWasWritten) {
  const auto sent = FromText<v1::LoopClosureMeasurement>(R"pb(
    x_meters: 1.5
    heading_radians: 3
    covariance {
      form: COVARIANCE_FORM_PLANAR_6
      values: [ 4, 0.1, 0.2, 5, 0.3, 0.06 ]
    }
  )pb");
  LinkContent link = LinkNoted("icp", "token:eva", 1700000000000000001);
  link.content.score = 0.0;
  link.content.measurement = MeasurementFieldsOf(sent);
  const std::string payload = EncodeLinkContent(link);
  v1::LoopClosureMeasurement measurement;
  ASSERT_THAT(
      ReadLinkContent(payload,
                      [&](const LinkContent& read) {
                        EXPECT_EQ(read.content.note, "icp");
                        EXPECT_EQ(read.content.decided_by, "token:eva");
                        EXPECT_EQ(read.content.score, 0.0);
                        EXPECT_EQ(read.create_time_ns, 1700000000000000001);
                        SetMeasurement(*read.content.measurement, &measurement);
                      }),
      IsOk());
  EXPECT_EQ(measurement.SerializeAsString(), sent.SerializeAsString());
  const auto decoded =
      DecodeLinkMeasurement(payload, core::StateSpace::kPlanar);
  ASSERT_THAT(decoded, IsOk());
  ASSERT_TRUE(decoded->has_value());
  EXPECT_EQ((*decoded)->relative.x, 1.5);
  EXPECT_EQ((*decoded)->covariance(0, 1), 0.1);
}

TEST(LinkContentTest, WithoutAMeasurementHasNone) {
  const auto decoded = DecodeLinkMeasurement(
      EncodeLinkContent(LinkNoted("", "", 1)), core::StateSpace::kPlanar);
  ASSERT_THAT(decoded, IsOk());
  EXPECT_FALSE(decoded->has_value());
}

TEST(LinkContentTest, SaysTheSameWhoeverAddedItAndWhenever) {
  const std::string first = EncodeLinkContent(LinkNoted("a", "x", 1));
  EXPECT_TRUE(LinkContentsSayTheSame(first, first));
  EXPECT_TRUE(
      LinkContentsSayTheSame(first, EncodeLinkContent(LinkNoted("a", "y", 2))));
  EXPECT_FALSE(
      LinkContentsSayTheSame(first, EncodeLinkContent(LinkNoted("b", "x", 1))));
  EXPECT_FALSE(LinkContentsSayTheSame(first, "\xff"));
}

TEST(LinkContentTest, HasTheTimeThatItIsGivenLater) {
  EXPECT_EQ(LinkContentCreatedAt(EncodeLinkContent(LinkNoted("a", "x", 1)),
                                 -1234567890123456789),
            EncodeLinkContent(LinkNoted("a", "x", -1234567890123456789)));
}

TEST(LinkContentTest, BytesThatAreNoLinkAreDamage) {
  const auto none = [](const LinkContent&) { ADD_FAILURE(); };
  EXPECT_THAT(ReadLinkContent("\xff", none), IsDamage());
  // A link has a time of creation.
  EXPECT_THAT(ReadLinkContent("", none), IsDamage());
  // The content within is no PosePairContent.
  EXPECT_THAT(ReadLinkContent("\x0a\x01\xff\x12\x02\x08\x01", none),
              IsDamage());
  EXPECT_THAT(DecodeLinkMeasurement("\xff", core::StateSpace::kPlanar),
              IsDamage());
}

}  // namespace
}  // namespace revisit::server
