// What the sketch of docs/hardware.md needs of Arduino's Ethernet library, over a serial line: a packet is a line.
// The library is not to be had here; the Arduino core, which this stands on, is the real one.
#pragma once
#include <Arduino.h>
#include <IPAddress.h>
#include <Udp.h>

class EthernetClass {
 public:
  void begin(uint8_t *mac, IPAddress ip);
};
extern EthernetClass Ethernet;

class EthernetUDP : public UDP {
 public:
  virtual uint8_t begin(uint16_t port);
  virtual void stop();
  virtual int beginPacket(IPAddress ip, uint16_t port);
  virtual int beginPacket(const char *host, uint16_t port);
  virtual int endPacket();
  virtual size_t write(uint8_t byte);
  virtual size_t write(const uint8_t *bytes, size_t size);
  using Print::write;
  virtual int parsePacket();
  virtual int available();
  virtual int read();
  virtual int read(unsigned char *bytes, size_t size);
  virtual int read(char *bytes, size_t size);
  virtual int peek();
  virtual void flush();
  virtual IPAddress remoteIP();
  virtual uint16_t remotePort();
};
