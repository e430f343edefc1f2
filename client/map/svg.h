// Pieces of SVG documents, and the colours that our drawings share.
//
// Coordinates are pixels, y downwards. `more` is further attributes, as text.
#ifndef REVISIT_CLIENT_MAP_SVG_H_
#define REVISIT_CLIENT_MAP_SVG_H_

#include <string>

namespace revisit::client {

inline constexpr char kInk[] = "#222222";
inline constexpr char kFaint[] = "#6b6b6b";
inline constexpr char kGrid[] = "#ececec";

inline constexpr char kMapEstimate[] = "#1f3b57";
inline constexpr char kMapTruth[] = "#9a9a9a";
inline constexpr char kMapEllipse[] = "#7b68b5";
inline constexpr char kMapClosure[] = "#2f7fd6";
inline constexpr char kMapRejection[] = "#b0306a";

// At most two digits after the point, without trailing zeros.
std::string SvgNumber(double value);

// Escapes text for use between tags and in attributes, and makes it
// Printable(): XML has no control characters at all.
std::string SvgEscaped(const std::string& text);

// Begins a document of this size with a title and a white ground.
// "</svg>\n" ends it.
std::string SvgBegin(double width, double height, const std::string& title);

// `anchor` is start, middle or end.
std::string SvgText(double x, double y, const std::string& text,
                    const char* color, const char* anchor,
                    const std::string& more);
std::string SvgLine(double x1, double y1, double x2, double y2,
                    const char* color, double width, const std::string& more);
std::string SvgCircle(double x, double y, double radius, const char* fill,
                      const char* stroke, double width);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_MAP_SVG_H_
