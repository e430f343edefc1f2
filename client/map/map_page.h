// The page of map_html.h without its data, from map_page.html and map_page.js.
#ifndef REVISIT_CLIENT_MAP_MAP_PAGE_H_
#define REVISIT_CLIENT_MAP_MAP_PAGE_H_

namespace revisit::client {

// The text of the page that its data replace.
inline constexpr char kMapDataMark[] = "@MAP_DATA@";

extern const char kMapPage[];

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_MAP_MAP_PAGE_H_
