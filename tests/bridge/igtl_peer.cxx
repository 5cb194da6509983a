// A peer that knows OpenIGTLink by its own library alone (Debian: libopenigtlink-dev).
//
//   igtl_peer HOST PORT                      print each message as one line, until the connection ends
//   igtl_peer HOST PORT point DEVICE X Y Z   send a list of one point, then the same
//   igtl_peer HOST PORT say DEVICE TEXT      send a string, then the same
//   igtl_peer HOST PORT slow MILLISECONDS    the same, waiting so long after each message
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <list>
#include <string>

#include "igtlClientSocket.h"
#include "igtlImageMessage.h"
#include "igtlMessageHeader.h"
#include "igtlOSUtil.h"
#include "igtlPointMessage.h"
#include "igtlPolyDataMessage.h"
#include "igtlStatusMessage.h"
#include "igtlStringMessage.h"
#include "igtlTransformMessage.h"

template <class Message>
typename Message::Pointer body(igtl::Socket* socket, igtl::MessageHeader* header) {
  typename Message::Pointer message = Message::New();
  message->SetMessageHeader(header);
  message->AllocatePack();
  socket->Receive(message->GetPackBodyPointer(), message->GetPackBodySize());
  if (!(message->Unpack(1) & igtl::MessageHeader::UNPACK_BODY)) {  // 1: check the CRC
    std::printf("DAMAGED %s\n", header->GetDeviceType());
    std::exit(1);
  }
  return message;
}

void print_matrix(igtl::Matrix4x4& m) {
  for (int row = 0; row < 3; row++)
    for (int column = 0; column < 4; column++) std::printf(" %.6f", m[row][column]);
}

int main(int argc, char* argv[]) {
  igtl::ClientSocket::Pointer socket = igtl::ClientSocket::New();
  if (argc < 3 || socket->ConnectToServer(argv[1], std::atoi(argv[2])) != 0) return 2;
  std::string order = argc > 3 ? argv[3] : "";
  int slow_ms = order == "slow" ? std::atoi(argv[4]) : 0;
  if (order == "point") {
    igtl::PointElement::Pointer point = igtl::PointElement::New();
    point->SetName("F-1");
    point->SetPosition(std::atof(argv[5]), std::atof(argv[6]), std::atof(argv[7]));
    igtl::PointMessage::Pointer message = igtl::PointMessage::New();
    message->SetDeviceName(argv[4]);
    message->AddPointElement(point);
    message->Pack();
    socket->Send(message->GetPackPointer(), message->GetPackSize());
  } else if (order == "say") {
    igtl::StringMessage::Pointer message = igtl::StringMessage::New();
    message->SetDeviceName(argv[4]);
    message->SetString(argv[5]);
    message->Pack();
    socket->Send(message->GetPackPointer(), message->GetPackSize());
  }
  igtl::MessageHeader::Pointer header = igtl::MessageHeader::New();
  while (true) {
    header->InitPack();
    if (socket->Receive(header->GetPackPointer(), header->GetPackSize()) != header->GetPackSize()) return 0;
    header->Unpack();
    igtl::TimeStamp::Pointer stamp = igtl::TimeStamp::New();
    header->GetTimeStamp(stamp);
    std::string type = header->GetDeviceType();
    std::printf("%s %s %.6f", type.c_str(), header->GetDeviceName(), stamp->GetTimeStamp());
    if (type == "IMAGE") {
      igtl::ImageMessage::Pointer image = body<igtl::ImageMessage>(socket, header);
      int size[3];
      image->GetDimensions(size);
      igtl::Matrix4x4 m;
      image->GetMatrix(m);  // whose axes have the length 1
      float spacing[3];
      image->GetSpacing(spacing);
      for (int row = 0; row < 3; row++)
        for (int column = 0; column < 3; column++) m[row][column] *= spacing[column];
      unsigned long sum = 0;
      const unsigned char* pixels = static_cast<unsigned char*>(image->GetScalarPointer());
      long count = static_cast<long>(size[0]) * size[1] * size[2] * image->GetNumComponents();
      for (long i = 0; i < count; i++) sum += (i % 251 + 1) * pixels[i];
      std::printf(" %d %d %d %d %lu", size[0], size[1], image->GetNumComponents(), image->GetCoordinateSystem(), sum);
      print_matrix(m);
    } else if (type == "TRANSFORM") {
      igtl::Matrix4x4 m;
      body<igtl::TransformMessage>(socket, header)->GetMatrix(m);
      print_matrix(m);
    } else if (type == "POINT") {
      igtl::PointMessage::Pointer list = body<igtl::PointMessage>(socket, header);
      for (int i = 0; i < list->GetNumberOfPointElement(); i++) {
        igtl::PointElement::Pointer point;
        list->GetPointElement(i, point);
        float x, y, z;
        point->GetPosition(x, y, z);
        igtlUint8 rgba[4];
        point->GetRGBA(rgba);
        std::printf(" %s;%.4f;%.4f;%.4f;%d;%d", point->GetName(), x, y, z, rgba[1], rgba[3]);
      }
    } else if (type == "POLYDATA") {
      igtl::PolyDataMessage::Pointer surface = body<igtl::PolyDataMessage>(socket, header);
      igtl::PolyDataPointArray::Pointer points = surface->GetPoints();
      igtl::PolyDataCellArray::Pointer cells = surface->GetPolygons();
      int corners = points.IsNull() ? 0 : points->GetNumberOfPoints();
      int triangles = cells.IsNull() ? 0 : cells->GetNumberOfCells();
      std::printf(" %d %d", corners, triangles);
      for (int i = 0; i < corners; i++) {
        igtlFloat32 p[3];
        points->GetPoint(i, p);
        std::printf(" %.4f;%.4f;%.4f", p[0], p[1], p[2]);
      }
      for (int i = 0; i < triangles; i++) {
        std::list<igtlUint32> cell;
        cells->GetCell(i, cell);
        for (std::list<igtlUint32>::iterator c = cell.begin(); c != cell.end(); ++c) std::printf(" %u", *c);
      }
    } else if (type == "STATUS") {
      igtl::StatusMessage::Pointer status = body<igtl::StatusMessage>(socket, header);
      std::printf(" %d %s", status->GetCode(), status->GetStatusString());
    } else if (type == "STRING") {
      std::printf(" %s", body<igtl::StringMessage>(socket, header)->GetString());
    } else {
      socket->Skip(header->GetBodySizeToRead(), 0);
    }
    std::printf("\n");
    std::fflush(stdout);
    if (slow_ms) igtl::Sleep(slow_ms);
  }
}
