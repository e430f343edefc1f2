#include "server/security/method_rules.h"

#include "gtest/gtest.h"
#include "revisit/v1/pose_graph_service.pb.h"

namespace revisit::server {
namespace {

TEST(MethodRulesTest, EveryMethodOfTheServiceHasOne) {
  const auto* file = v1::GetServerInfoRequest::descriptor()->file();
  int methods = 0;
  for (int i = 0; i < file->service_count(); ++i) {
    for (int j = 0; j < file->service(i)->method_count(); ++j, ++methods) {
      const std::string& name = file->service(i)->method(j)->name();
      EXPECT_NE(FindMethodRule(name), nullptr) << name;
    }
  }
  EXPECT_GT(methods, 0);
}

TEST(MethodRulesTest, WhatDestroysTakesAdmin) {
  EXPECT_EQ(FindMethodRule("DeleteVehicle")->verb, Verb::kAdmin);
  EXPECT_EQ(FindMethodRule("AcceptDataLoss")->verb, Verb::kAdmin);
  EXPECT_EQ(FindMethodRule("StreamPoses")->verb, Verb::kWrite);
  EXPECT_EQ(FindMethodRule("ExportPoseGraph")->verb, Verb::kRead);
}

TEST(MethodRulesTest, UnknownMethodsHaveNone) {
  EXPECT_EQ(FindMethodRule("Stream"), nullptr);
}

}  // namespace
}  // namespace revisit::server
