// The page of map_html.h without its data, from map_page.html.
#ifndef REVISIT_CLIENT_CLI_MAP_MAP_PAGE_H_
#define REVISIT_CLIENT_CLI_MAP_MAP_PAGE_H_

namespace revisit::client {

// What stands in the page in place of the data.
inline constexpr char kMapDataMark[] = "@MAP_DATA@";

extern const char kMapPage[];

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_MAP_MAP_PAGE_H_
