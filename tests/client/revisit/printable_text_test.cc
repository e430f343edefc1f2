#include "client/revisit/printable_text.h"

#include "gtest/gtest.h"

namespace revisit::client {
namespace {

TEST(PrintableTextTest, TextOfAnyScriptStays) {
  for (const char* text :
       {"", "shuttle-7, 100 %", "caf\u00e9", "\u0645\u062d\u0637\u0629",
        "\u5317\u4eac \u3000", "\u0939\u093f\u0928\u094d\u0926\u0940",
        "\U0001f697", "e\u0301", "\u00a0"}) {
    EXPECT_EQ(Printable(text), text);
    EXPECT_EQ(PrintableLines(text), text);
    EXPECT_EQ(PrintableJson(text), text);
  }
}

TEST(PrintableTextTest, WhatCouldSteerOrDeceiveIsShownByItsNumber) {
  EXPECT_EQ(Printable("\x1b[2Jred\x07"), "<U+001B>[2Jred<U+0007>");
  EXPECT_EQ(Printable(std::string("a\0b", 3)), "a<U+0000>b");
  EXPECT_EQ(Printable("a\r\n\tb"), "a<U+000D><U+000A><U+0009>b");
  EXPECT_EQ(Printable("\x7f\u0080\u009b\u009f"),
            "<U+007F><U+0080><U+009B><U+009F>");
  EXPECT_EQ(Printable("\u202egnp\u2069"), "<U+202E>gnp<U+2069>");
  EXPECT_EQ(Printable("a\u200bb\u200dc\ufeff\u00ad"),
            "a<U+200B>b<U+200D>c<U+FEFF><U+00AD>");
  EXPECT_EQ(Printable("\u2028\u2029\u061c\ufe0f\ufff9\u3164"),
            "<U+2028><U+2029><U+061C><U+FE0F><U+FFF9><U+3164>");
  EXPECT_EQ(Printable("\U000e0041\U000e0100"), "<U+E0041><U+E0100>");
}

TEST(PrintableTextTest, BytesThatAreNoCharacterAreShownEachByItself) {
  EXPECT_EQ(Printable("\x9b"
                      "31m"),
            "<9B>31m");
  EXPECT_EQ(Printable("\xff\xc3"), "<FF><C3>");
  EXPECT_EQ(Printable("\xe2\x80"), "<E2><80>");
  // ESC and U+009B in forms that are longer than needed, a surrogate, and a
  // number beyond Unicode.
  EXPECT_EQ(Printable("\xc0\x9b"), "<C0><9B>");
  EXPECT_EQ(Printable("\xe0\x82\x9b"), "<E0><82><9B>");
  EXPECT_EQ(Printable("\xf0\x80\x82\x9b"), "<F0><80><82><9B>");
  EXPECT_EQ(Printable("\xed\xa0\x80"), "<ED><A0><80>");
  EXPECT_EQ(Printable("\xf4\x90\x80\x80"), "<F4><90><80><80>");
  EXPECT_EQ(Printable("\xf8\x88\x80\x80\x80"), "<F8><88><80><80><80>");
}

TEST(PrintableTextTest, LinesKeepTheirBreaksOnly) {
  EXPECT_EQ(PrintableLines("a\n\tb\r\x1b\u2028"),
            "a\n\tb<U+000D><U+001B><U+2028>");
}

TEST(PrintableTextTest, JsonKeepsItsValues) {
  EXPECT_EQ(PrintableJson("{\n \"a\": \"\x7f\u009b\u202e\U000e0041\u00e9\"\n}"),
            "{\n \"a\": \"\\u007f\\u009b\\u202e\\udb40\\udc41\u00e9\"\n}");
}

}  // namespace
}  // namespace revisit::client
