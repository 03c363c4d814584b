-- Wireshark dissector for the packets of an evstim instrument. Written by `evstim export wireshark`.
-- Copy it to the folder of personal Lua plugins (Help, About Wireshark, Folders), or: tshark -X lua_script:evstim.lua
-- It reads space packets in UDP datagrams (one or several in each), in ISO-TP on CAN ("Decode As"), and in captures of
-- link type 147 (USER0).

local proto = Proto("evstim", "evstim instrument")
local fields, packets, by_key = {}, {}, {}

local MAKERS = {
  {8, ProtoField.uint8, ProtoField.int8}, {16, ProtoField.uint16, ProtoField.int16},
  {24, ProtoField.uint24, ProtoField.int24}, {32, ProtoField.uint32, ProtoField.int32},
  {64, ProtoField.uint64, ProtoField.int64},
}

-- A field: its position, its width and its display. The same filter name is registered once.
local known = {}
local function field(abbr, label, at, bits, meaning, more)
  more = more or {}
  local this = known[abbr]
  if not this then
    if more.scale then
      this = ProtoField.double(abbr, label, meaning)
    else
      for _, maker in ipairs(MAKERS) do
        if bits <= maker[1] then
          local make = more.signed and maker[3] or maker[2]
          this = make(abbr, label, more.hex and base.HEX or base.DEC, more.choices, nil, meaning)
          break
        end
      end
    end
    known[abbr] = this
    table.insert(fields, this)
  end
  return {proto = this, at = at, bits = bits, scale = more.scale, signed = more.signed}
end

local function packet(type, apid, service, subtype, one)
  by_key[string.format("%d/%d/%d/%d", type, apid, service, subtype)] = one
  if one.rest then
    local make = one.rest.kind == "text" and ProtoField.string or ProtoField.bytes
    one.rest.proto = make(one.rest.abbr, one.rest.label)
    table.insert(fields, one.rest.proto)
  end
end

--@PACKETS@

local crc_good = ProtoField.bool("evstim.error_control.good", "error control good")
table.insert(fields, crc_good)
proto.fields = fields
local bad_crc = ProtoExpert.new("evstim.bad_crc", "the error control is wrong", expert.group.CHECKSUM, expert.severity.ERROR)
local bad_length = ProtoExpert.new("evstim.bad_length", "the length is wrong", expert.group.MALFORMED, expert.severity.ERROR)
local unknown = ProtoExpert.new("evstim.unknown", "no packet of this instrument", expert.group.UNDECODED, expert.severity.NOTE)
proto.experts = {bad_crc, bad_length, unknown}

-- CRC-16-CCITT-FALSE; the operator is compiled if the language has it.
local bxor = (bit32 and bit32.bxor) or (bit and bit.bxor) or load("return function(a, b) return a ~ b end")()
local crc_table = {}
for byte = 0, 255 do
  local crc = byte * 256
  for _ = 1, 8 do
    crc = crc >= 32768 and bxor((crc * 2) % 65536, 0x1021) or crc * 2
  end
  crc_table[byte] = crc
end

local function crc16(octets)
  local crc = 0xFFFF
  for n = 0, octets:len() - 1 do
    crc = bxor((crc % 256) * 256, crc_table[bxor(math.floor(crc / 256), octets:get_index(n))])
  end
  return crc
end

local function show(tree, tvb, one, from)
  local bit_at = from * 8 + one.at
  local first, last = math.floor(bit_at / 8), math.floor((bit_at + one.bits - 1) / 8)
  local range = tvb(first, last - first + 1)
  local value = range:bitfield(bit_at % 8, one.bits)
  if one.signed and one.bits <= 32 and value >= 2 ^ (one.bits - 1) then
    value = value - 2 ^ one.bits
  end
  if one.scale then
    value = tonumber(tostring(value)) * one.scale
  end
  tree:add(one.proto, range, value)
end

local function show_rest(tree, tvb, rest, from, length)
  if rest.kind ~= "records" then
    if length > 0 then
      tree:add(rest.proto, tvb(from, length))
    end
    return
  end
  for at = from, from + length - rest.octets, rest.octets do
    local record = tree:add(rest.proto, tvb(at, rest.octets))
    for _, one in ipairs(rest.fields) do
      show(record, tvb, one, at)
    end
  end
end

-- Shows one whole packet; returns its name.
local function dissect(tvb, tree)
  local size = tvb:len()
  local id = tvb(0, 2):uint()
  local type, apid = math.floor(id / 4096) % 2, id % 2048
  for _, one in ipairs(PRIMARY) do
    show(tree, tvb, one, 0)
  end
  local service, subtype = -1, -1
  if size >= 9 then
    service, subtype = tvb(7, 1):uint(), tvb(8, 1):uint()
  end
  local found = by_key[string.format("%d/%d/%d/%d", type, apid, service, subtype)]
  if not found then
    tree:add_proto_expert_info(unknown)
    return string.format("APID 0x%X, not of this instrument", apid)
  end
  tree:append_text(": " .. found.name)
  local rest = size - found.before_rest - 2
  if rest < found.shortest or rest > found.longest then
    tree:add_proto_expert_info(bad_length)
    return found.name .. ", wrong length"
  end
  for _, one in ipairs(found.fields) do
    show(tree, tvb, one, 0)
  end
  if found.rest then
    show_rest(tree, tvb, found.rest, found.before_rest, rest)
  end
  show(tree, tvb, ERROR_CONTROL, size - 2)
  local good = crc16(tvb:bytes()) == 0
  tree:add(crc_good, tvb(size - 2, 2), good)
  if not good then
    tree:add_proto_expert_info(bad_crc)
    return found.name .. ", wrong CRC"
  end
  return found.name
end

function proto.dissector(tvb, info, root)
  info.cols.protocol = "evstim"
  local at, names = 0, {}
  while at < tvb:len() do
    local left = tvb:len() - at
    local size = left >= 6 and tvb(at + 4, 2):uint() + 7 or left + 1
    local tree = root:add(proto, tvb(at, math.min(size, left)))
    if size > left then
      tree:add_proto_expert_info(bad_length)
      table.insert(names, "cut")
      break
    end
    table.insert(names, dissect(tvb(at, size):tvb(), tree))
    at = at + size
  end
  info.cols.info = table.concat(names, ", ")
  return tvb:len()
end

for _, port in ipairs(UDP_PORTS) do
  DissectorTable.get("udp.port"):add(port, proto)
end
DissectorTable.get("udp.port"):add_for_decode_as(proto)
DissectorTable.get("wtap_encap"):add(wtap.USER0, proto)
pcall(function() DissectorTable.get("iso15765.subdissector"):add_for_decode_as(proto) end)
--@CAN@
