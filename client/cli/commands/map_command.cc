#include "client/cli/commands/map_command.h"

#include <memory>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/cli/commands/shared_flags.h"
#include "client/map/map_geojson.h"
#include "client/map/map_html.h"
#include "client/map/map_svg.h"
#include "client/revisit/printable_text.h"
#include "client/terminal/output_file.h"

namespace revisit::client {

namespace {

constexpr char kMapDetails[] =
    "Shows what the server knows: the trajectory, the 95 % uncertainty at "
    "each check, the\n"
    "candidates by verdict, and what was confirmed and rejected. Candidates "
    "are asked for\n"
    "along the whole path, as a stream's checks would have been, with the "
    "closures and\n"
    "rejections that there are now. With --group, it shows the paths of the "
    "group's other\n"
    "vehicles too, in the frame of this one's last recording, with the loop "
    "closures between\n"
    "them; those that nothing ties to it lie beside it.";

constexpr char kMapExamples[] =
    "  revisit map shuttle-7 --output shuttle-7.html\n"
    "  revisit map shuttle-7 --svg --direction either > shuttle-7.svg\n"
    "  revisit map shuttle-7 --geojson --check-interval 200 --output "
    "shuttle-7.geojson\n"
    "  revisit map shuttle-8 --group depot --exclude-own --output depot.html";

// Says what is wrong with the flags taken together; empty if nothing is.
std::string CheckOptions(const Command& command, const MapOptions& options) {
  if (command.Given("--html") + command.Given("--svg") +
          command.Given("--geojson") >
      1) {
    return "--html, --svg, --geojson: one of them only";
  }
  if (command.Given("--geojson") + command.Given("--group") > 1) {
    return "--geojson: of one vehicle only, not with --group";
  }
  if (options.searches.interval_meters.value_or(1.0) <= 0.0) {
    return "--check-interval: must be positive";
  }
  if (options.searches.per_second <= 0.0) {
    return "--searches-per-second: must be positive";
  }
  return "";
}

}  // namespace

void AddMapCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"map", "Draws a vehicle's trajectory with its loop-closure candidates.",
       kMapDetails, kMapExamples});
  const auto options = std::make_shared<MapOptions>();
  AddVehicleName(command, &options->vehicle);
  const auto add_format = [&](const char* name, MapFormat format,
                              const char* help) {
    command.AddSwitch(
        name, [options, format](bool) { options->format = format; }, help);
  };
  add_format("--html", MapFormat::kHtml,
             "One page for a browser, with all that it needs (the default): it "
             "moves, zooms, and shows numbers where it is clicked");
  add_format("--svg", MapFormat::kSvg, "A drawing");
  add_format("--geojson", MapFormat::kGeoJson,
             "Longitude and latitude (RFC 7946); for vehicles that stream "
             "geodetic positions");
  command.AddText("--output", "FILE", &options->output,
                  "File to write instead of standard output");
  command.AddNumber(
      "--check-interval", "M",
      [options](double meters) { options->searches.interval_meters = meters; },
      "Travelled distance between two searches (the vehicle's own)");
  command.AddNumber("--searches-per-second", "N", &options->searches.per_second,
                    "At most so many, for the sake of others");
  AddScope(command, &options->searches.options);
  AddDirection(command, &options->searches.options);
  const Check check = [command, options] {
    return CheckOptions(command, *options);
  };
  command.Runs(
      [options](const Connection& server, const Terminal& terminal) {
        return RunMap(server.client, *options, terminal);
      },
      check);
}

absl::Status RunMap(const Client& client, const MapOptions& options,
                    const Terminal& terminal) {
  const std::string vehicle = VehicleName(options.vehicle);
  const std::string& group = options.searches.options.scope().group();
  auto map = group.empty() ? ReadServerMap(client, vehicle, terminal)
                           : ReadGroupMap(client, vehicle, group, terminal);
  if (!map.ok()) return map.status();
  if (options.format == MapFormat::kGeoJson) {
    if (absl::Status fits = CheckGeodetic(map->vehicle); !fits.ok()) {
      return fits;
    }
  }
  if (absl::Status added = AddChecks(client, options.searches, terminal, &*map);
      !added.ok()) {
    return added;
  }
  const absl::Status written =
      WriteTo(options.output, terminal.out, [&](std::ostream& out) {
        switch (options.format) {
          case MapFormat::kHtml:
            out << MapPage(map->contents);
            break;
          case MapFormat::kSvg:
            out << DrawMap(map->contents);
            break;
          case MapFormat::kGeoJson:
            WriteGeoJson(*map, out);
            break;
        }
        return CheckOutput(out);
      });
  if (!written.ok()) return written;
  std::string report = absl::StrCat(Printable(map->vehicle.name()), ": ",
                                    map->contents.checks.size(), " searches");
  for (const MapStyle& style : map->contents.styles) {
    absl::StrAppend(&report, ", ", style.label);
  }
  terminal.progress << report << '\n';
  return absl::OkStatus();
}

}  // namespace revisit::client
