// Asks a table what tests/test_cpp_table.py wants to know. A line of the input is a question, one of the output an answer.
//   p CAMERA X Y Z                where a camera sees a position
//   t U V SD U V SD ...           where a point is
// With a second argument the same questions are answered by so many threads at once, which must say the same.
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include "implicam.hpp"

namespace {

double number(std::istream& in) {
  std::string word;
  in >> word;
  return std::strtod(word.c_str(), nullptr);
}

std::string digits(double x) {
  char text[40];
  std::snprintf(text, sizeof text, " %.17g", x);
  return text;
}

std::string answer(const implicam::Rig& rig, const std::string& question) {
  std::istringstream in(question);
  std::string what, out;
  in >> what;
  if (what == "p") {
    int camera = 0;
    in >> camera;
    const double x = number(in), y = number(in), z = number(in);
    const implicam::Pixel seen = rig.project(camera, x, y, z);
    out = std::to_string(static_cast<int>(seen.status)) + digits(seen.uv[0]) + digits(seen.uv[1]);
    for (const auto& row : seen.covariance)
      for (const double entry : row) out += digits(entry);
    return out;
  }
  std::vector<implicam::View> views(static_cast<std::size_t>(rig.cameras()));
  for (implicam::View& view : views) {
    view.u = number(in);
    view.v = number(in);
    view.sd = number(in);
  }
  const implicam::Position found = rig.triangulate(views);
  out = std::to_string(static_cast<int>(found.status));
  for (const double x : found.xyz) out += digits(x);
  for (const auto& row : found.covariance)
    for (const double entry : row) out += digits(entry);
  out += digits(found.chi_squared) + digits(found.p) + " " + std::to_string(found.views);
  int left_out = -1, second = -1;
  if (!found.left_out.empty()) left_out = found.left_out[0];
  if (found.left_out.size() > 1) second = found.left_out[1];
  return out + " " + std::to_string(left_out) + " " + std::to_string(second);
}

}  // namespace

int main(int count, char** words) {
  implicam::Rig rig;
  const implicam::Status status = count > 1 ? rig.load(words[1]) : implicam::Status::cannot_read;
  if (status != implicam::Status::ok) {
    std::printf("%d %s\n", static_cast<int>(status), implicam::message(status));
    return 3;
  }
  std::vector<std::string> questions, answers;
  for (std::string line; std::getline(std::cin, line);) questions.push_back(line);
  for (const std::string& question : questions) answers.push_back(answer(rig, question));
  if (count > 2) {
    std::vector<std::vector<std::string>> others(static_cast<std::size_t>(std::atoi(words[2])));
    std::vector<std::thread> threads;
    for (auto& mine : others)
      threads.emplace_back([&rig, &questions, &mine] {
        for (const std::string& question : questions) mine.push_back(answer(rig, question));
      });
    for (std::thread& thread : threads) thread.join();
    for (const auto& mine : others)
      if (mine != answers) return 4;
  }
  for (const std::string& line : answers) std::printf("%s\n", line.c_str());
  return 0;
}
