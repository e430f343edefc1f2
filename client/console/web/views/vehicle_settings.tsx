// How the server keeps and searches a vehicle.
import {type JsonValue, toJson} from '@bufbuild/protobuf';

import {type VehicleSettings, VehicleSettingsSchema} from
    '../../gen/revisit/v1/vehicle_pb.js';
import {type Fact, FactList} from '../parts/facts.js';

const UNITS: Array<[RegExp, string]> = [
  [/Meters$/, ' m'], [/Radians$/, ' rad'], [/Degrees$/, '°'],
];

/** A name such as nodeSpacingMeters in words, without its unit. */
function nameOf(key: string): string {
  const bare = UNITS.reduce((text, [unit]) => text.replace(unit, ''), key);
  const text = bare.replace(/[A-Z]/g, letter => ` ${letter.toLowerCase()}`);
  return text[0].toUpperCase() + text.slice(1);
}

function textOf(key: string, value: JsonValue): string {
  if (value !== null && typeof value === 'object') {
    return Object.entries(value).map(
        ([name, part]) => `${nameOf(name).toLowerCase()} ${
            textOf(name, part as JsonValue)}`).join(', ');
  }
  if (typeof value === 'boolean') return value ? 'yes' : 'no';
  if (typeof value === 'number') {
    const unit = UNITS.find(([suffix]) => suffix.test(key))?.[1] ?? '';
    return `${value.toLocaleString('en', {maximumFractionDigits: 9})}${unit}`;
  }
  // Names of enumerations begin with that of the enumeration.
  const prefix = key.replace(/[A-Z]/g, letter => `_${letter}`).toUpperCase();
  return /^[A-Z0-9_]+$/.test(String(value)) ?
      String(value).replace(`${prefix}_`, '').replaceAll('_', ' ')
          .toLowerCase() :
      String(value);
}

function settingFacts(settings: VehicleSettings): Fact[] {
  const json = toJson(VehicleSettingsSchema, settings, {
    alwaysEmitImplicit: true}) as Record<string, JsonValue>;
  return Object.entries(json).map(
      ([key, value]) => [nameOf(key), textOf(key, value)]);
}

export function Settings({settings}: {settings: VehicleSettings}) {
  return (
    <details class="settings">
      <summary>Settings</summary>
      <FactList facts={settingFacts(settings)} />
    </details>
  );
}
