#include "client/map/svg.h"

#include "client/revisit/printable_text.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

std::string SvgNumber(double value) {
  std::string text = Fixed(value, 2);
  text.erase(text.find_last_not_of('0') + 1);
  if (text.back() == '.') text.pop_back();
  return text == "-0" ? "0" : text;
}

std::string SvgEscaped(const std::string& text) {
  std::string escaped;
  for (const char c : Printable(text)) {
    switch (c) {
      case '&':
        escaped += "&amp;";
        break;
      case '<':
        escaped += "&lt;";
        break;
      case '>':
        escaped += "&gt;";
        break;
      case '"':
        escaped += "&quot;";
        break;
      default:
        escaped += c;
    }
  }
  return escaped;
}

std::string SvgBegin(double width, double height, const std::string& title) {
  return "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"" +
         SvgNumber(width) + "\" height=\"" + SvgNumber(height) +
         "\" viewBox=\"0 0 " + SvgNumber(width) + " " + SvgNumber(height) +
         "\" font-family=\"'Helvetica Neue', Helvetica, Arial, 'DejaVu Sans', "
         "sans-serif\" font-size=\"13\">\n<title>" +
         SvgEscaped(title) +
         "</title>\n<rect width=\"100%\" height=\"100%\" "
         "fill=\"#ffffff\"/>\n";
}

std::string SvgText(double x, double y, const std::string& text,
                    const char* color, const char* anchor,
                    const std::string& more) {
  return "<text x=\"" + SvgNumber(x) + "\" y=\"" + SvgNumber(y) + "\" fill=\"" +
         color + "\" text-anchor=\"" + anchor + "\" " + more + ">" +
         SvgEscaped(text) + "</text>\n";
}

std::string SvgLine(double x1, double y1, double x2, double y2,
                    const char* color, double width, const std::string& more) {
  return "<line x1=\"" + SvgNumber(x1) + "\" y1=\"" + SvgNumber(y1) +
         "\" x2=\"" + SvgNumber(x2) + "\" y2=\"" + SvgNumber(y2) +
         "\" stroke=\"" + color + "\" stroke-width=\"" + SvgNumber(width) +
         "\" " + more + "/>\n";
}

std::string SvgCircle(double x, double y, double radius, const char* fill,
                      const char* stroke, double width) {
  return "<circle cx=\"" + SvgNumber(x) + "\" cy=\"" + SvgNumber(y) +
         "\" r=\"" + SvgNumber(radius) + "\" fill=\"" + fill + "\" stroke=\"" +
         stroke + "\" stroke-width=\"" + SvgNumber(width) + "\"/>\n";
}

}  // namespace revisit::client
