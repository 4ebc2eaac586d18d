// SPDX-License-Identifier: Apache-2.0
// Six sensors on A0 to A5 as lines of numbers: count, time, codes, check. On the host:
//   Skin("text:///dev/ttyACM0?baud=115200&before=index,us&after=check", nodes=6, bits=10)
const uint8_t PINS[] = {A0, A1, A2, A3, A4, A5};
uint32_t frames, check;

void put(uint32_t number) {
  check = check * 31 + number;  // modulo 2^32, as the host computes it
  Serial.print(number);
  Serial.print(',');
}

void setup() { Serial.begin(115200); }

void loop() {
  check = 0;
  put(frames++);
  put(micros());
  for (uint8_t pin : PINS) put(analogRead(pin));
  Serial.println(check);
}
