
-- Frames of the CAN bus, by their identifiers. Wireshark's own dissector of ISO-TP passes messages of several frames to
-- the one above:  tshark -d can.subdissector,iso15765 -d iso15765.subdissector,evstim

local can = Proto("evstim_can", "evstim instrument on CAN")
local can_fields, frames = {}, {}
local can_id_of = Field.new("can.id")

local function signal(abbr, label, at, bits, more)
  more = more or {}
  local make = more.scale and ProtoField.double or bits > 32 and ProtoField.uint64 or ProtoField.uint32
  local this = more.scale and make(abbr, label) or make(abbr, label, base.DEC, more.choices)
  table.insert(can_fields, this)
  return {proto = this, at = at, bits = bits, scale = more.scale, big = more.big}
end

--@FRAMES@

can.fields = can_fields

-- The lowest bit of a number is at `at`, counted from the lowest bit of the first octet; big-endian ones fill octets.
local function can_value(range, one)
  if one.big then
    return range:uint()
  elseif one.bits > 32 then
    return range:le_uint64()
  end
  local value = 0
  for n = range:len() - 1, 0, -1 do
    value = value * 256 + range(n, 1):uint()
  end
  return math.floor(value / 2 ^ (one.at % 8)) % 2 ^ one.bits
end

function can.dissector(tvb, info, root)
  local id = can_id_of().value % 2048
  local frame = frames[id]
  info.cols.protocol = "evstim CAN"
  info.cols.info = frame.name
  local tree = root:add(can, tvb(), "evstim instrument on CAN: " .. frame.name)
  for _, one in ipairs(frame) do
    local first = math.floor(one.at / 8)
    local last = one.big and first + one.bits / 8 - 1 or math.floor((one.at + one.bits - 1) / 8)
    if last < tvb:len() then
      local range = tvb(first, last - first + 1)
      local value = can_value(range, one)
      tree:add(one.proto, range, one.scale and value * one.scale or value)
    end
  end
  return tvb:len()
end

for id in pairs(frames) do
  DissectorTable.get("can.id"):add(id, can)
end
