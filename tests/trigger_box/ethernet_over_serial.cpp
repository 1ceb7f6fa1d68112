#include "Ethernet.h"

EthernetClass Ethernet;
static char line[64], sent[80];
static uint8_t got, at, size_sent;

void EthernetClass::begin(uint8_t *, IPAddress) { Serial.begin(115200); }

uint8_t EthernetUDP::begin(uint16_t) {
  Serial.print("READY\n");
  return 1;
}

void EthernetUDP::stop() {}

int EthernetUDP::beginPacket(IPAddress, uint16_t) {
  size_sent = 0;
  return 1;
}

int EthernetUDP::beginPacket(const char *, uint16_t) {
  size_sent = 0;
  return 1;
}

int EthernetUDP::endPacket() {
  Serial.write((uint8_t *)sent, size_sent);
  return 1;
}

size_t EthernetUDP::write(uint8_t byte) {
  if (size_sent < sizeof(sent)) sent[size_sent++] = byte;
  return 1;
}

size_t EthernetUDP::write(const uint8_t *bytes, size_t size) {
  for (size_t i = 0; i < size; i++) write(bytes[i]);
  return size;
}

int EthernetUDP::parsePacket() {
  while (Serial.available()) {
    char letter = Serial.read();
    if (got < sizeof(line)) line[got++] = letter;
    if (letter == '\n') {
      at = 0;
      return got;
    }
  }
  return 0;
}

int EthernetUDP::available() { return got - at; }
int EthernetUDP::read() { return at < got ? line[at++] : -1; }
int EthernetUDP::read(unsigned char *bytes, size_t size) { return read((char *)bytes, size); }

int EthernetUDP::read(char *bytes, size_t size) {
  size_t i = 0;
  while (i < size && at < got) bytes[i++] = line[at++];
  got = at = 0;
  return i;
}

int EthernetUDP::peek() { return at < got ? line[at] : -1; }
void EthernetUDP::flush() {}
IPAddress EthernetUDP::remoteIP() { return IPAddress(192, 168, 0, 2); }
uint16_t EthernetUDP::remotePort() { return 4000; }
